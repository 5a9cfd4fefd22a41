"""Tables as Markdown, CSV, LaTeX and terminal output, from the same cells."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table as RichTable

from proprio_mllm.report.summary import Row

_LATEX: Final = {
    "\\": r"\textbackslash{}",
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
    "<": r"\textless{}",
    ">": r"\textgreater{}",
    "·": r"\textperiodcentered{}",
    **{sign: f"\\{sign}" for sign in "&%$#_{}"},
}


def latex_text(text: str) -> str:
    """Text with every sign that LaTeX would read as a command written as itself; lines become one."""
    return "".join(_LATEX.get(sign, sign) for sign in " ".join(text.split()))


def _plain(cell: str) -> str:
    """A cell of Markdown that neither ends early nor draws anything: names of models are what servers say."""
    return "".join(f"\\{sign}" if sign in "|<>`\\" else sign for sign in " ".join(cell.split()))


@dataclass(frozen=True, slots=True)
class Table:
    """A titled grid of text.

    Attributes:
        title: what it shows.
        columns: headings.
        rows: cells, as many as headings.
        notes: lines below the table.

    Raises:
        ValueError: when a row has another number of cells.
    """

    title: str
    columns: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        for row in self.rows:
            if len(row) != len(self.columns):
                raise ValueError(f"row {row!r} has {len(row)} cells, expected {len(self.columns)}")

    def to_markdown(self) -> str:
        """The table with its title and notes."""
        widths = [max(len(_plain(cell)) for cell in column) for column in zip(self.columns, *self.rows, strict=True)]

        def line(cells: Sequence[str]) -> str:
            return "| " + " | ".join(cell.ljust(width) for cell, width in zip(map(_plain, cells), widths, strict=True)) + " |"

        rule = "|" + "|".join("-" * (width + 2) for width in widths) + "|"
        notes = [f"\n{note}" for note in self.notes]
        return "\n".join([f"**{self.title}**", "", line(self.columns), rule, *(line(row) for row in self.rows), *notes]) + "\n"

    def to_csv(self) -> str:
        """Heading and rows."""
        buffer = io.StringIO()
        writer = csv.writer(buffer, lineterminator="\n")
        writer.writerow(self.columns)
        writer.writerows(self.rows)
        return buffer.getvalue()

    def to_latex(self) -> str:
        """A `table` environment in the style of the package booktabs, which the document has to load."""

        def line(cells: Sequence[str]) -> str:
            # A group of its own: a cell that starts with a bracket is no argument of the line break before it.
            return " & ".join("{" + text + "}" if text.startswith("[") else text for text in map(latex_text, cells)) + r" \\"

        layout = "l" + "r" * (len(self.columns) - 1)
        return (
            "\n".join(
                [
                    "% needs \\usepackage{booktabs}",
                    r"\begin{table}",
                    r"\centering",
                    rf"\caption{{{latex_text(self.title)}}}",
                    rf"\begin{{tabular}}{{{layout}}}",
                    r"\toprule",
                    line(self.columns),
                    r"\midrule",
                    *(line(row) for row in self.rows),
                    r"\bottomrule",
                    r"\end{tabular}",
                    *(rf"\par\footnotesize {latex_text(note)}" for note in self.notes),
                    r"\end{table}",
                ]
            )
            + "\n"
        )

    def show(self, console: Console | None = None) -> None:
        """Prints notes first and the table last, so that a run ends with its rows."""
        width = sum(max(len(cell) for cell in column) + 3 for column in zip(self.columns, *self.rows, strict=True))
        # Cells are never cut: on a narrow terminal the lines wrap instead.
        console = console or Console(width=max(width + 4, Console().width), highlight=False)
        for note in self.notes:
            console.print(note, style="dim", markup=False)
        grid = RichTable(title=self.title, title_justify="left", show_edge=False, box=SIMPLE_HEAD)
        for number, column in enumerate(self.columns):
            grid.add_column(column, justify="left" if number == 0 else "right", no_wrap=True)
        for row in self.rows:
            grid.add_row(*row)
        console.print(grid)


def rate_cell(row: Row) -> str:
    """`63.2 [54.7, 70.9] 84/133`, empty without an episode."""
    return _cell(row.success_rate, row.low, row.high, row.successes, row.episodes)


def in_time_cell(row: Row) -> str:
    """`rate_cell` of the successes in time."""
    return _cell(row.in_time_rate, row.in_time_low, row.in_time_high, row.in_time, row.episodes)


def first_try_cell(row: Row) -> str:
    """Share of first tries in reach, in %; empty without one."""
    return _number(100 * row.extras.first_try_rate)


def _cell(rate: float, low: float, high: float, count: int, episodes: int) -> str:
    return f"{100 * rate:.1f} [{100 * low:.1f}, {100 * high:.1f}] {count}/{episodes}" if episodes else ""


def _number(value: float, digits: int = 1) -> str:
    return "" if math.isnan(value) else f"{value:.{digits}f}"


def run_table(title: str, rows: Sequence[Row], notes: Sequence[str] = ()) -> Table:
    """The table of one run: one row per category and one for all. Times are left out, so that equal runs give equal tables."""
    columns = (
        "category",
        "success %, 95 % interval",
        "in time %, 95 % interval",
        "SPL",
        "first try %",
        "navigation",
        "body adj.",
        "logical",
        "invalid",
        "budget",
        "stuck",
        "goals %",
        "calls",
        "tokens",
    )
    body = [
        (
            row.category,
            rate_cell(row),
            in_time_cell(row),
            _number(100 * row.extras.spl),
            first_try_cell(row),
            str(row.navigation),
            str(row.body_adjustment),
            str(row.logical),
            str(row.invalid_output),
            str(row.budget_exhausted),
            str(row.stuck),
            _number(100 * row.goal_conditions),
            _number(row.calls),
            _number(row.tokens, 0),
        )
        for row in rows
    ]
    return Table(title, columns, tuple(body), tuple(notes))
