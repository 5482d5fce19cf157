"""The report: one page with everything in it, and the tables as Markdown."""

from __future__ import annotations

import base64
import html
from collections.abc import Sequence
from dataclasses import dataclass

from colmap_refract.experiments import tables
from colmap_refract.experiments.results import ExperimentResult, judged

TITLE = "The paper's experiments, simulated"
INTRO = (
    "The experiments of Ichimaru, Taguchi and Kawasaki, Unified Underwater Structure-from-Motion (3DV 2019), on "
    "simulated captures of the same set-ups: their photographs were never published. What the paper does not give,"
    " such as the size of the waves, is said with each experiment. Every capture is drawn anew for every seed; "
    "figures are the median over the seeds, and the least and the largest. The noise bound is what the noise of "
    "the keypoints leaves, however the points are found (Cramer and Rao; with waves, for a solver that knows their"
    " statistics). Points are compared with the truth after a similarity alignment, all that a method gives, and "
    "how many those are is said beside it."
)
_STYLE = """
body { font: 16px/1.5 system-ui, sans-serif; max-width: 75rem; margin: 2rem auto; padding: 0 1rem; color: #222; }
table { border-collapse: collapse; margin: 1rem 0; font-size: 0.9rem; }
th, td { border: 1px solid #999; padding: 0.25rem 0.5rem; text-align: left; }
th { background: #eee; }
img { max-width: 100%; height: auto; }
figure { margin: 1rem 0; }
figcaption { color: #444; font-size: 0.9rem; }
.wide { overflow-x: auto; }
"""


@dataclass(frozen=True, kw_only=True)
class Figure:
    """A picture of the report."""

    experiment: str
    name: str
    """Of its file."""
    data: bytes
    text: str

    @property
    def media_type(self) -> str:
        return "image/svg+xml" if self.name.endswith(".svg") else "image/png"


@dataclass(frozen=True, kw_only=True)
class Report:
    """All that is reported of a call."""

    command: str
    environment: str
    noise: float
    """Of the keypoints, px."""
    seeds: Sequence[int]
    results: Sequence[ExperimentResult]
    figures: Sequence[Figure]

    @property
    def facts(self) -> list[str]:
        """How this came about, a sentence each."""
        listed = ", ".join(map(str, self.seeds))
        return [
            f"Seeds: {listed}. Keypoints have {self.noise:g} px of noise per axis, the root mean square error of SIFT "
            "on rendered pictures, where an experiment does not start from pictures.",
            f"{self.environment}.",
            *(f"{result.title}: {result.seconds:.0f} s, all seeds, one process." for result in self.results),
        ]


def markdown(report: Report) -> str:
    """The tables, `results.md`."""
    parts = [f"# {TITLE}", f"    {report.command}", INTRO, "\n".join(f"- {fact}" for fact in report.facts)]
    parts += ["## Methods", tables.markdown(tables.METHOD_HEADINGS, tables.method_rows(report.results))]
    for result in report.results:
        parts += [f"## {result.title}", result.text]
        parts.append(tables.markdown(tables.outlier_heading(result), tables.rows(result)))
        parts += [f"- {fact.text}: {fact.value}" for fact in result.facts]
        parts.append("\n".join(f"- {judged(finding, result)}" for finding in result.findings))
        if said := tables.remarks(result):
            parts.append("What failed, and what methods say of their results:")
            parts.append("\n".join(f"- {line}" for line in said))
    return "\n\n".join(part for part in parts if part) + "\n"


def page(report: Report) -> str:
    """The page, `index.html`: nothing in it is elsewhere."""
    parts = [f"<h1>{_text(TITLE)}</h1>", f"<p>{_text(INTRO)}</p>", f"<pre>{_text(report.command)}</pre>"]
    parts.append(_listed(report.facts))
    links = "".join(f'<li><a href="#{result.name}">{_text(result.title)}</a></li>' for result in report.results)
    parts.append(f"<nav><ul>{links}</ul></nav><h2>Methods</h2>")
    parts.append(
        _table(tables.METHOD_HEADINGS, tables.method_rows(report.results), "The methods and what they are given")
    )
    for result in report.results:
        parts.append(f'<h2 id="{result.name}">{_text(result.title)}</h2><p>{_text(result.text)}</p>')
        parts.append(_table(tables.outlier_heading(result), tables.rows(result), f"{result.title}: what was measured"))
        if result.facts:
            parts.append(_listed([f"{fact.text}: {fact.value}" for fact in result.facts]))
        if result.findings:
            parts.append(_listed([judged(finding, result) for finding in result.findings]))
        for figure in report.figures:
            if figure.experiment == result.name:
                parts.append(_figure(figure))
        if said := tables.remarks(result):
            parts.append("<p>What failed, and what methods say of their results:</p>" + _listed(said))
    body = "\n".join(parts)
    return (
        f'<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n<title>{_text(TITLE)}</title>\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<style>{_STYLE}</style>\n</head>\n<body>\n<main>\n{body}\n</main>\n</body>\n</html>\n"
    )


def _text(words: str) -> str:
    """Escaped; what stands between backquotes is code."""
    parts = html.escape(words).split("`")
    return "".join(f"<code>{part}</code>" if k % 2 else part for k, part in enumerate(parts))


def _listed(lines: Sequence[str]) -> str:
    return "<ul>" + "".join(f"<li>{_text(line)}</li>" for line in lines) + "</ul>"


def _table(headings: Sequence[str], rows: Sequence[Sequence[str]], caption: str) -> str:
    head = "".join(f'<th scope="col">{_text(heading)}</th>' for heading in headings)
    body = "".join("<tr>" + "".join(f"<td>{_text(cell)}</td>" for cell in row) + "</tr>\n" for row in rows)
    return f'<div class="wide"><table><caption>{_text(caption)}</caption><tr>{head}</tr>\n{body}</table></div>'


def _figure(figure: Figure) -> str:
    data = base64.b64encode(figure.data).decode("ascii")
    source = f"data:{figure.media_type};base64,{data}"
    return (
        f'<figure><img src="{source}" alt="{html.escape(figure.text)}">'
        f"<figcaption>{_text(figure.text)}</figcaption></figure>"
    )


def summary(result: ExperimentResult) -> str:
    """An experiment in a few lines, for a terminal."""
    lines = [f"{result.title} ({result.seconds:.0f} s)"]
    for row in tables.rows(result):
        lines.append(f"  {row[0]:26} {row[1]:20} RMSE {row[2]:24} mm, bound {row[3]} mm, failed {row[9]}")
    return "\n".join(lines) + "\n"
