"""``python -m sonosweep`` is the command line."""

from sonosweep.cli.main import main

main()
