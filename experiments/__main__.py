"""Lists the commands with a line each: `python -m experiments`."""

import ast
from pathlib import Path

from rich.table import Table

from experiments.common.cli import console


def commands() -> dict[str, str]:
    """Finds every command and the sentence that says what it does.

    Modules are parsed and not imported, so the list appears at once, and a missing optional dependency hides no
    command.

    Returns:
      First lines of the docstrings by name of the command, in alphabetical order.
    """
    found = {}
    for path in sorted(Path(__file__).parent.glob("[!_]*.py")):
        text = ast.get_docstring(ast.parse(path.read_text())) or ""
        found[path.stem] = text.partition("\n")[0].partition(": `")[0].rstrip(".")
    return found


def main() -> None:
    """Prints the table of commands, for a user who does not know their names yet."""
    table = Table("command", "what it does", box=None)
    for name, sentence in commands().items():
        table.add_row(f"python -m experiments.{name}", sentence)
    console.print(table)
    console.print("Each one explains its options with --help.")


if __name__ == "__main__":
    main()
