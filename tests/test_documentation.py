"""Whatever the documentation shows is run."""

import doctest
import importlib
import pkgutil
import re
import runpy
import shlex
import sys
from pathlib import Path

import pytest

import sonosweep
from sonosweep.cli.app import app

ROOT = Path(__file__).parents[1]
PAGES = sorted([ROOT / "README.md", *(ROOT / "docs").glob("*.md")])
MODULES = sorted(module.name for module in pkgutil.walk_packages(sonosweep.__path__, "sonosweep."))


def commands(page: Path) -> list[str]:
    """Return the sonosweep command lines in a page's code blocks."""
    blocks = re.findall(r"^ *```(?:bash|console|)\n(.*?)^ *```", page.read_text(), re.M | re.S)
    lines = "\n".join(blocks).replace("\\\n", " ").splitlines()
    return [line.strip() for line in lines if line.strip().startswith("sonosweep ")]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_python_in_pages(page):
    """Every Python example of a page prints what the page says."""
    result = doctest.testfile(str(page), module_relative=False)

    assert result.failed == 0


@pytest.mark.parametrize("name", MODULES)
def test_python_in_docstrings(name):
    """Every Python example of a docstring prints what the docstring says."""
    result = doctest.testmod(importlib.import_module(name))

    assert result.failed == 0


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_commands_in_pages(page):
    """Every command line of a page names a verb and options that exist."""
    for line in commands(page):
        words = shlex.split(line, comments=True)[1:]
        app.parse_args(words, exit_on_error=False, print_error=False)


def test_the_table_of_networks_is_what_its_script_prints(monkeypatch, capsys):
    """Size, speed and errors of the shipped networks, and apart from them the paper's."""
    monkeypatch.setattr(sys, "argv", ["", str(ROOT / "docs/results/table1.csv")])
    runpy.run_path(str(ROOT / "benchmarks/network_table.py"), run_name="__main__")

    page = (ROOT / "docs/estimators.md").read_text()
    ours, papers = capsys.readouterr().out.strip().split("\n\n")

    assert ours in page
    assert papers in page
