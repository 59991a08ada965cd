"""``python -m sonosweep`` is the command line."""

from sonosweep.cli.main import main

if __name__ == "__main__":
    main()
