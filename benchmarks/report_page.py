"""How a page with many episodes behaves: `python -m benchmarks.report_page RUN [RUN ...] [count]`.

The episodes of the runs, with their pictures, are repeated under other names until there are `count` (700). Chromium opens the
page; times are those of the page itself (`performance.now`), layout included.
"""

from __future__ import annotations

import dataclasses
import itertools
import json
import sys
import tempfile
from pathlib import Path

from configs.help import asks_for_help
from proprio_mllm.report.html import page, run_data
from proprio_mllm.report.stored import load_run
from tests.browser import Browser, chromium

_TIMED = "(() => {{ const start = performance.now(); {} document.body.offsetHeight; return performance.now() - start; }})()"
_TYPED = "const q = document.getElementById('q'); q.value = '{}'; q.dispatchEvent(new Event('input'));"
_CHOSEN = "const o = document.getElementById('outcome'); o.value = '{}'; o.dispatchEvent(new Event('change'));"
_PRESSED = "document.getElementById('rows').dispatchEvent(new KeyboardEvent('keydown', {key: 'ArrowDown'}));"
_SORTED = "document.querySelector('#sort-steps button').click();"


def main(arguments: list[str]) -> None:
    if not [name for name in arguments if not name.isdigit()] or asks_for_help(arguments):
        raise SystemExit(__doc__)
    count = int(arguments[-1]) if arguments[-1].isdigit() else 700
    runs = [run_data(load_run(Path(name)), "all") for name in arguments if not name.isdigit()]
    many = [dataclasses.replace(run, episodes=()) for run in runs]
    share = -(-count // len(runs))
    for number, run in enumerate(runs):
        copies = itertools.islice(itertools.cycle(run.episodes), share)
        own = tuple({**one, "task": f"{one['task']}_{copy}"} for copy, one in enumerate(copies))
        many[number] = dataclasses.replace(run, episodes=own)
    program = chromium()
    if program is None:
        raise SystemExit("no Chromium here; install the package `chromium`")
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "report.html"
        path.write_text(page(many), encoding="utf-8")
        browser = Browser(program, 1400, 1000)
        try:
            loads = []
            for _ in range(3):
                browser.open(path)
                loads.append(browser.eval("performance.getEntriesByType('navigation')[0].loadEventStart"))
            steps = {
                "type a word": _TYPED.format("task_1"),
                "clear it": _TYPED.format(""),
                "choose failures": _CHOSEN.format("failure"),
                "choose all": _CHOSEN.format(""),
                "sort": _SORTED,
                "open the next episode": _PRESSED,
            }
            times = {name: min(browser.eval(_TIMED.format(code)) for _ in range(3)) for name, code in steps.items()}
            nodes = browser.eval("document.querySelectorAll('*').length")
        finally:
            browser.close()
        figures = {
            "episodes": share * len(runs),
            "megabytes": round(path.stat().st_size / 1e6, 2),
            "load_ms": round(min(loads)),
            **{f"{name}_ms": round(value, 1) for name, value in times.items()},
            "elements": nodes,
        }
        print(json.dumps(figures, indent=1))


if __name__ == "__main__":
    main(sys.argv[1:])
