"""The report in a real browser: it starts, turns, picks, and complains about nothing."""

import re
import shutil
import subprocess

import pytest

from sonosweep.view import report_page

GRAPHICS = ("GL Driver Message", "software WebGL")
NAMES = ("chromium", "chromium-browser", "google-chrome")
BROWSER = next((path for name in NAMES if (path := shutil.which(name))), None)

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(BROWSER is None, reason="needs Chromium or Chrome on the path"),
]

DRIVE = """<script>(async () => {
  const $ = id => document.getElementById(id), wait = ms => new Promise(r => setTimeout(r, ms));
  window.addEventListener('error', e => { document.body.dataset.error = e.message; });
  window.addEventListener('unhandledrejection', e => { document.body.dataset.error = e.reason; });
  while (!document.documentElement.dataset.viewer) await wait(20);
  const set = (id, value, kind) => { $(id).value = value; $(id).dispatchEvent(new Event(kind)); };
  await wait(100);
  for (const mode of ['depth', 'maximum', 'render']) {
    set('v-mode', mode, 'change'); await wait(50);
  }
  if ($('v-overlay').options.length > 1) { set('v-overlay', '1', 'change'); await wait(50); }
  if (!$('cut-0').closest('[hidden]')) {
    const box = $('cut-1').getBoundingClientRect();
    for (const kind of ['pointerdown', 'pointermove'])
      $('cut-1').dispatchEvent(new PointerEvent(kind, { pointerId: 1,
        clientX: box.left + box.width / 2, clientY: box.top + box.height / 2 }));
    set('slice-0', 13, 'input'); set('v-level', 60, 'input');
  }
  set('v-run', $('v-run').options.length - 1, 'change');
  set('v-frame', 7, 'input'); $('v-show-outlines').click();
  // Drawing follows when the browser has time for it, which on a busy machine is later.
  for (let k = 0; k < 8000 && !/frame 7/.test($('v-frame-name').textContent); k++) await wait(50);
  await wait(300);
  document.title = 'driven';
})();</script></body>"""


def visit(page: str, folder, *options: str) -> tuple[str, str]:
    """Return the page as the browser leaves it, and what it said."""
    path = folder / "page.html"
    path.write_text(page.replace("</body>", DRIVE), encoding="utf-8")
    assert BROWSER is not None
    flags = "headless no-sandbox disable-quic no-first-run disable-background-networking"
    flags += " disable-component-update disable-sync dump-dom enable-logging=stderr"
    command = [
        BROWSER,
        *(f"--{flag}" for flag in flags.split()),
        f"--user-data-dir={folder / 'profile'}",
        "--virtual-time-budget=600000",
        "--window-size=1200,1600",
        *options,
        path.as_uri(),
    ]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)
    # Notes on software graphics are no complaints of the page.
    said = [
        line
        for line in done.stderr.splitlines()
        if "CONSOLE" in line and not any(note in line for note in GRAPHICS)
    ]
    return done.stdout, "\n".join(said)


@pytest.mark.parametrize(
    ("option", "drawn"), [("--enable-unsafe-swiftshader", "webgl"), ("--disable-3d-apis", "canvas")]
)
def test_the_interactive_view_works(report, tmp_path, option, drawn):
    """With WebGL and without, every control can be used and nothing is reported as an error."""
    left, said = visit(report_page(report), tmp_path, option)

    assert said == ""
    assert "<title>driven</title>" in left
    assert f'data-viewer="{drawn}"' in left
    assert "data-error" not in left
    assert re.search(r'id="v-frame-name">frame 7 of 20<', left)
    assert re.search(r'id="where-0">elevational 13\.0 mm<', left)


def test_a_trajectory_alone_can_be_looked_at(report, tmp_path):
    """Without a volume and frames the page still shows and turns the trajectory."""
    from dataclasses import replace

    runs = tuple(replace(run, volume=None, companions={}) for run in report.runs)

    left, said = visit(report_page(replace(report, runs=runs, frames=None)), tmp_path)

    assert said == ""
    assert "<title>driven</title>" in left
    assert "data-error" not in left
