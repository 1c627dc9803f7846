"""Inputs that must be refused: one sound set of files, and more than a hundred ways to spoil it.

    for name, case in cases().items():
        argv = case.write(folder)

The command line argv must give exit status 2 and one line that holds case.says.
"""

from malformed.archives import broken_archives, other_archives
from malformed.case import Builder
from malformed.commands import command_lines, models
from malformed.robots import of_robots
from malformed.tables import (
    cells,
    exchanges,
    headers,
    infinities,
    no_tables,
    other_files,
    other_separators,
    times,
    too_little,
    units,
)


def cases():
    """{name: Case}."""
    add = Builder()
    for family in (
        *(no_tables, other_separators, other_files, headers, cells, infinities, times),
        *(units, exchanges, too_little, broken_archives, other_archives, models, command_lines),
    ):
        family(add)
    return add.found | of_robots(add.good)
