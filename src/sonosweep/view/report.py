"""The report: one HTML file that needs nothing else, can be mailed, printed and trusted.

All numbers come in; nothing is computed here. The page asks no server for anything, and says
so to the browser, which enforces it.
"""

import os
from collections.abc import Iterable
from html import escape
from importlib.resources import files
from urllib.parse import quote

from sonosweep.io.atomic import write_beside
from sonosweep.view.content import Report, ReportRun
from sonosweep.view.figures import Track, draw_drift, draw_steps, draw_trajectories
from sonosweep.view.metric_table import metric_table
from sonosweep.view.payload import Payload, make_payload
from sonosweep.view.stills import still_pictures

POLICY = (
    "default-src 'none'; img-src data: blob:; style-src 'unsafe-inline'; "
    "script-src 'unsafe-inline'; base-uri 'none'; form-action 'none'"
)
NOTICE = "Research software, not a medical device. Do not use for diagnosis or treatment."


def write_report(path: str | os.PathLike, report: Report) -> None:
    """Write the report as one self-contained HTML file.

    Args:
        path: Where; replaced only when the whole file is written.
        report: What it says.

    Raises:
        FormatError: If the file cannot be written.
    """
    page = report_page(report)
    with write_beside(path) as temporary:
        temporary.write_text(page, encoding="utf-8")


def report_page(report: Report) -> str:
    """Return the report as the text of an HTML page."""
    payload = make_payload(report)
    sections = [
        _verdict(report),
        _facts(report),
        _asset("viewer.html"),
        _section("Accuracy", metric_table(report.runs)),
        _section("Trajectory", _plots(report)),
        _section("Volume", still_pictures(report.runs)),
        _section("What was assumed", _list(_assumptions(report))),
        _section("Files", _files(report)),
        _section("How it was made", _provenance(report)),
    ]
    return (
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">'
        f'<meta http-equiv="Content-Security-Policy" content="{escape(POLICY)}">'
        '<meta name="viewport" content="width=device-width,initial-scale=1">'
        f"<title>{escape(report.title)}</title><style>{_asset('page.css')}</style></head><body>"
        f'<div class="strip" role="note">{NOTICE}</div><main>'
        f"<h1>{escape(report.title)}</h1>{''.join(sections)}"
        "<footer>Made by sonosweep. This page holds everything it shows and asks no server for "
        f"anything.</footer></main>{_data(payload)}"
        f"<script>{_asset('viewer.js')}</script></body></html>\n"
    )


def _asset(name: str) -> str:
    return (files("sonosweep.view") / name).read_text(encoding="utf-8")


def _section(title: str, content: str) -> str:
    return f"<section><h2>{escape(title)}</h2>{content}</section>" if content else ""


def _verdict(report: Report) -> str:
    sentences = "".join(f"<p>{escape(sentence)}</p>" for sentence in report.verdict)
    return f'<div class="verdict"><h2>In short</h2>{sentences}</div>' if sentences else ""


def _facts(report: Report) -> str:
    pairs = "".join(
        f"<div><dt>{escape(label)}</dt><dd>{escape(value)}</dd></div>"
        for label, value in report.facts
    )
    return f'<dl class="facts">{pairs}</dl>' if pairs else ""


def _plots(report: Report) -> str:
    tracks = [Track(run.name, run.trajectory) for run in report.runs]
    drifts = [
        (run.name, run.drift_mm, k) for k, run in enumerate(report.runs) if run.drift_mm is not None
    ]
    plots = [_plot(draw_trajectories(tracks, report.frame_size_mm))]
    if max(len(run.trajectory.image_to_reference) for run in report.runs) > 1:
        plots.append(_plot(draw_steps(tracks)))
    if drifts:
        plots.append(_plot(draw_drift(drifts), " full"))
    return f'<div class="plots">{"".join(plots)}</div>'


def _plot(drawn: str, kind: str = "") -> str:
    return f'<div class="plot{kind}">{drawn}</div>'


def _assumptions(report: Report) -> Iterable[str]:
    """Return the report's assumptions and those of its trajectories, each once."""
    made = (words for run in report.runs for words in run.trajectory.assumptions)
    return dict.fromkeys((*report.assumptions, *made))


def _list(sentences: Iterable[str]) -> str:
    items = "".join(f"<li>{escape(sentence)}</li>" for sentence in sentences)
    return f"<ul>{items}</ul>" if items else ""


def _files(report: Report) -> str:
    """Return links to files beside the report; a name that is no plain name is only shown."""
    items = []
    for name in report.outputs:
        shown = f"<code>{escape(name)}</code>"
        plain = name and not name.startswith((".", "/", "\\")) and ":" not in name
        items.append(
            f'<li><a href="{quote(name)}">{shown}</a></li>' if plain else f"<li>{shown}</li>"
        )
    return f"<ul>{''.join(items)}</ul>" if items else ""


def _provenance(report: Report) -> str:
    command = f"<pre>{escape(report.command)}</pre>" if report.command else ""
    versions = ", ".join(f"{name} {version}" for name, version in report.versions.items())
    settings = _list(_made(run) for run in report.runs)
    return command + settings + (f"<p>{escape(versions)}</p>" if versions else "")


def _made(run: ReportRun) -> str:
    """Return how a trajectory and a volume were made, in one line."""
    made = dict(run.trajectory.settings) | dict(run.volume.settings if run.volume else {})
    words = [f"{name} {value}" for name, value in made.items()]
    return f"{run.name}: " + ", ".join([f"poses {run.trajectory.method}", *words])


def _data(payload: Payload) -> str:
    volumes = "".join(
        f'<script type="application/octet-stream" id="volume-{k}">{text}</script>'
        for k, text in enumerate(payload.volumes)
    )
    sheet = f' src="{payload.sheet}"' if payload.sheet else ""
    return (
        f'<img id="cine-sheet" alt="" hidden{sheet}>{volumes}'
        f'<script type="application/json" id="viewer-data">{payload.description}</script>'
    )
