"""The page of a run: what it says, that hostile text stays text, that it asks for nothing, and how it behaves in a browser."""

from __future__ import annotations

import dataclasses
import json
import re
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from interface.episode import Outcome
from proprio_mllm.evaluation.ledger import Ledger
from proprio_mllm.report.frames import act_out, episode_id
from proprio_mllm.report.html import main, page, run_data
from proprio_mllm.report.reenact import RunTasks
from proprio_mllm.report.stored import load_run
from sim.tasks.task import write_tasks
from tests.browser import Browser
from tests.report.ledgers import HOSTILE, LAMP, failed, fine, record_of, step, write_run

HEIGHT = failed("Pick(left, Mug_1)", "BodyTooHigh", "body_adjustment", height_m=-0.12, reach_m=0.05)
SLIPPED = failed("Pick(left, Mug_1)", "Slipped", "logical", "slipped")
INVALID = {**failed("", "InvalidOutput", "logical"), "message": HOSTILE}


class Page(HTMLParser):
    """Elements of a page with their attributes, and the text of its script elements by id."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.elements: list[tuple[str, dict[str, str | None]]] = []
        self.scripts: dict[str, str] = {}
        self._script = ""
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append((tag, dict(attrs)))
        self._script = dict(attrs).get("id") or "" if tag == "script" else ""

    def handle_endtag(self, tag: str) -> None:
        self._script = ""

    def handle_data(self, data: str) -> None:
        if self._script:
            self.scripts[self._script] = self.scripts.get(self._script, "") + data

    def data(self, name: str) -> Any:
        return json.loads(self.scripts[name])


@pytest.fixture
def run(tmp_path: Path) -> Path:
    tasks = [dataclasses.replace(LAMP, id=name) for name in ("good", "bad")]
    bad = [step(fine("GoTo(Mug_1)")), step(HEIGHT), step(INVALID, text=HOSTILE), step(SLIPPED)]
    folder = write_run(tmp_path / "run", tasks, [(True, [step(fine("Pick(right, Mug_1)"))]), (False, bad)])
    with Ledger(folder / "ledger.jsonl") as ledger:
        own = load_run(folder).records[0].config_hash
        ledger.append(record_of(tasks[0], "x1", own, False, [], outcome=Outcome.INFRASTRUCTURE_ERROR, message=HOSTILE))
    return folder


def test_the_page_says_what_the_ledger_says(run: Path) -> None:
    text = page([run_data(load_run(run), "none")])
    found = Page(text)
    good, bad, broken = (found.data(f"episode-{number}") for number in range(3))
    assert [one["outcome"] for one in found.data("listed")] == ["success", "failure", "infrastructure_error"]
    assert found.data("listed")[1]["codes"] == "BodyTooHigh InvalidOutput Slipped"
    assert good["instruction"] == LAMP.instruction and good["why"] is None
    assert [goal["text"] for goal in good["goals"]] == ["held(Mug_1)", "not(open(Drawer_1))"]
    assert bad["why"]["step"] == 4 and "Pick(left, Mug_1) failed with Slipped" in bad["why"]["text"]
    assert bad["trace"][1]["outcomes"][0]["margins_in_words"] == [
        "X1's pelvis is 0.12 m too high (height_m -0.12)",
        "the target is 0.05 m beyond X1's reach (reach_m +0.05)",
    ]
    assert bad["trace"][2]["step"] == HOSTILE and bad["trace"][2]["outcomes"][0]["meaning"] == HOSTILE
    assert bad["trace"][3]["outcomes"][0]["contingency"] == "slipped"
    assert broken["message"] == HOSTILE
    assert all(word in text for word in ("python eval.py planner=random", "1 attempts broke", "50.0", "9.5–90.5"))


def test_nothing_is_asked_for_and_hostile_text_is_no_markup(run: Path) -> None:
    meta = json.loads((run / "run.json").read_text())
    (run / "run.json").write_text(json.dumps(meta | {"label": HOSTILE, "command": HOSTILE}))
    text = page([run_data(load_run(run), "none")])
    found = Page(text)
    assert not re.search(r"https?:|//[a-z]", text)
    assert {tag for tag, _ in found.elements}.isdisjoint({"img", "link", "iframe", "object", "base", "b"})
    for tag, attributes in found.elements:
        assert not any(name.startswith("on") or name in ("src", "href", "style") for name in attributes), tag
    assert "49" not in found.scripts["names"], "what a run says is no template"
    assert text.count("</script>") == sum(tag == "script" for tag, _ in found.elements)
    policy = next(values["content"] for tag, values in found.elements if tag == "meta" and "http-equiv" in values)
    assert policy is not None and policy.startswith("default-src 'none'; img-src data:;") and "unsafe" not in policy


def test_equal_runs_give_equal_pages_and_several_fit_on_one(run: Path, tmp_path: Path) -> None:
    data = run_data(load_run(run), "none")
    assert page([data]) == page([run_data(load_run(run), "none")])
    both = Page(page([data, data]))
    assert [one["run"] for one in both.data("listed")] == [0, 0, 0, 1, 1, 1]
    assert main([str(run), str(run), f"out={tmp_path}/new/two.html", "frames=none"]) == 0
    assert Page((tmp_path / "new" / "two.html").read_text()).data("names") == ["Random · x1 · easy · tasks"] * 2
    assert main([str(run), "frames=none"]) == 0
    assert (run / "report.html").is_file()


def test_an_episode_whose_task_has_changed_is_shown_without_it(run: Path, caplog: pytest.LogCaptureFixture) -> None:
    write_tasks([dataclasses.replace(LAMP, id="good", seed=5)], run.parent / "tasks.jsonl")
    data = run_data(load_run(run), "all", workers=0)
    assert "'good'" in data.episodes[0]["note"] and "has changed" in data.episodes[0]["note"]
    assert "'bad'" in data.episodes[1]["note"] and "not there any more" in data.episodes[1]["note"]
    assert data.episodes[0]["goals"] == [] and data.episodes[0]["instruction"] == ""
    assert data.episodes[1]["why"]["step"] is None
    assert "episode-2" in Page(page([data])).scripts


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ([], "expected RUN [RUN ...]"),
        (["{run}", "{run}"], "2 runs need out=FILE.html"),
        (["{run}/none"], "run.json is missing"),
        (["{run}", "out=page.pdf"], "out must end in .html, got 'page.pdf'"),
        (["{run}", "frames=some"], "frames: 'some'"),
        (["{run}", "size=9"], "size 9 outside 32..640"),
        (["{run}", "workers=999"], "workers 999 outside 0..256"),
        (["{run}", "colour=red"], "colour: unknown key"),
    ],
)
def test_wrong_arguments(run: Path, arguments: list[str], said: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([argument.format(run=run) for argument in arguments]) == 2
    assert said in capsys.readouterr().err


# ---- acted out in the simulator


def test_acting_out_gives_pictures_goals_and_what_differs(acted_run: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run = load_run(acted_run)
    (record,) = run.records
    data = run_data(run, "all", 64, 0)
    (episode,) = data.episodes
    acted = data.acted[episode["id"]]
    assert len(acted.shown) == len(acted.goals) == record.steps + 1 and len(acted.codes) == record.steps
    assert acted.shown[2] == acted.shown[1], "an invalid reply changes nothing"
    assert not any(entry["differs"] for entry in episode["trace"])
    assert episode["trace"][2]["outcomes"][0]["margins_in_words"][0].startswith("H1's pelvis is 0.05 m too low (height_m +0.0")
    lifted, shut = episode["goals"]
    assert (record.outcome, lifted["since"], shut["since"]) == (Outcome.SUCCESS, 5, 0)
    assert lifted["held"] == [False] * 5 + [True] and shut["held"] == [True] * 6
    # A second report reads what is kept: nothing is acted out.
    monkeypatch.setattr("proprio_mllm.report.frames.run_jobs", None)
    assert run_data(run, "all", 64, 0).acted == data.acted
    assert (acted_run / "frames" / f"{episode_id(record)}-64.json").is_file()


def test_a_step_that_ends_otherwise_is_marked(acted_run: Path, tmp_path: Path) -> None:
    run = load_run(acted_run)
    (record,) = run.records
    trace = [dict(entry) for entry in record.trace]
    trace[0] = step(failed("GoTo(HousePlant_1)", "NoFreePose", "navigation"))
    changed = dataclasses.replace(record, trace=tuple(trace))
    acted = act_out([(tmp_path, RunTasks(run).episode(changed))], 32, 0)[episode_id(changed)]
    assert acted.codes[0] == ("",)
    data = dataclasses.replace(run, folder=tmp_path, records=(changed,))
    entries = run_data(data, "all", 32, 0).episodes[0]["trace"]
    assert [entry["differs"] for entry in entries] == [True, False, False, False, False]


def test_what_cannot_be_acted_out_is_said_and_not_kept(acted_run: Path, tmp_path: Path) -> None:
    run = load_run(acted_run)
    changed = dataclasses.replace(run.records[0], trace=(step(fine("Fly(left, Mug_1)")),))
    data = run_data(dataclasses.replace(run, folder=tmp_path, records=(changed,)), "all", 32, 0)
    assert "could not be acted out again: unknown action 'Fly'" in data.episodes[0]["note"]
    assert not (tmp_path / "frames").exists()


# ---- in a browser


@pytest.fixture(scope="module")
def pages(acted_run: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The acted-out episode, and 700 more that are like it but for names and outcomes."""
    acted = run_data(load_run(acted_run), "all", 64, 0)
    (real,) = acted.episodes
    rng = np.random.default_rng(0)
    many = []
    for number in range(700):
        outcome = ["success", "failure"][int(rng.integers(2))]
        category = ["single", "optional", "essential"][number % 3]
        own = {"id": f"{number:016x}", "task": f"task_{number}", "outcome": outcome, "category": category, "steps": number % 37}
        many.append({**real, **own, "failure": None if outcome == "success" else "navigation", "why": None})
    data = dataclasses.replace(
        acted, episodes=(real, *many), acted={name["id"]: acted.acted[real["id"]] for name in (real, *many)}
    )
    path = tmp_path_factory.mktemp("page") / "report.html"
    path.write_text(page([data]))
    return path


ROWS = "[...document.querySelectorAll('#body tr[aria-rowindex]')].map((row) => row.id)"


@pytest.mark.chromium
def test_an_opened_episode_shows_everything_and_asks_for_nothing(browser: Browser, pages: Path) -> None:
    browser.open(pages, "#episode=0")
    said = browser.eval("document.getElementById('episode').innerText")
    assert "Lift the <b>plant</b> with both hands." in said and HOSTILE[:60] in said
    assert "BodyTooLow" in said and "lifted(HousePlant_1)" in said and "since step 5" in said and "from the start" in said
    images = "[...document.querySelectorAll('#episode img')]"
    assert browser.eval(f"Promise.all({images}.map((one) => one.decode())).then(() => {images}.length)") == 6
    assert browser.eval("document.title") != "taken" and browser.eval("document.querySelectorAll('img[onerror]').length") == 0
    assert all(url.startswith(("file:", "data:image/jpeg;base64,")) for url in browser.requests)
    assert browser.messages == []


@pytest.mark.chromium
def test_filters_order_and_links(browser: Browser, pages: Path) -> None:
    browser.open(pages, "#outcome=failure&category=optional&sort=steps&desc=1&q=TASK_1")
    listed = json.loads(Page(pages.read_text()).scripts["listed"])
    wanted = [
        (one["steps"], number)
        for number, one in enumerate(listed)
        if one["outcome"] == "failure" and one["category"] == "optional" and "task_1" in one["task"]
    ]
    ordered = [f"row-{number}" for _, number in sorted(wanted, key=lambda pair: (-pair[0], pair[1]))]
    assert browser.eval(ROWS) == ordered[: len(browser.eval(ROWS))]
    assert browser.eval("document.getElementById('count').textContent").startswith(f"{len(ordered)} of 701 episodes")
    assert browser.eval("document.getElementById('outcome').value") == "failure"
    browser.eval("document.querySelector('#filters button').click()")
    assert browser.eval("document.getElementById('count').textContent").startswith("701 of 701")
    browser.eval(
        "document.getElementById('q').value = 'nothing like it'; document.getElementById('q').dispatchEvent(new Event('input'))"
    )
    assert browser.eval(ROWS) == [] and "q=nothing" in browser.eval("location.hash")


@pytest.mark.chromium
def test_only_rows_in_view_are_drawn_and_keys_open_episodes(browser: Browser, pages: Path) -> None:
    browser.open(pages)
    assert 10 < len(browser.eval(ROWS)) < 80
    assert browser.eval("document.querySelectorAll('img').length") == 0
    browser.eval("document.getElementById('rows').focus()")
    for key in ("ArrowDown", "ArrowDown", "ArrowDown", "ArrowUp"):
        browser.press(key)
    assert "episode=1" in browser.eval("location.hash")
    assert browser.eval("document.getElementById('rows').getAttribute('aria-activedescendant')") == "row-1"
    browser.press("End")
    assert "episode=700" in browser.eval("location.hash")
    row = browser.eval("(({top, bottom}) => [top, bottom])(document.getElementById('row-700').getBoundingClientRect())")
    pane = browser.eval("(({top, bottom}) => [top, bottom])(document.getElementById('list').getBoundingClientRect())")
    assert pane[0] <= row[0] and row[1] <= pane[1] + 1
    assert len(browser.eval(ROWS)) < 80
    assert browser.messages == []


@pytest.mark.chromium
def test_700_episodes_are_quick(browser: Browser, pages: Path) -> None:
    """Generous limits: a machine at work is several times slower than an idle one."""
    assert browser.open(pages) < 10.0
    timed = "(() => {{ const start = performance.now(); {} document.body.offsetHeight; return performance.now() - start; }})()"
    typing = "const q = document.getElementById('q'); q.value = 'task_6'; q.dispatchEvent(new Event('input'));"
    assert browser.eval(timed.format(typing)) < 300
    assert browser.eval(timed.format("location.hash = '#episode=500';")) < 300


@pytest.mark.chromium
def test_narrow_and_printed(browser: Browser, pages: Path) -> None:
    browser.resize(420, 900)
    try:
        browser.open(pages, "#episode=0")
        assert browser.eval("document.documentElement.scrollWidth") <= 420
    finally:
        browser.resize(1280, 900)
    browser.open(pages, "#q=task_60&episode=0")
    browser.eval("dispatchEvent(new Event('beforeprint'))")
    assert len(browser.eval(ROWS)) == 11
    assert len(browser.pdf()) > 20_000


@pytest.mark.chromium
def test_the_policy_holds_even_if_markup_got_in(browser: Browser, pages: Path) -> None:
    browser.open(pages)
    handler = "<img src='data:image/png;base64,AA' onerror='document.title=1'><img src='file:///nothing.png' id='outside'>"
    browser.eval(f"document.body.insertAdjacentHTML('beforeend', {json.dumps(handler)})")
    assert browser.eval("fetch('file:///etc/hostname').then(() => 'read', () => 'refused')") == "refused"
    browser.eval("new Promise((done) => setTimeout(done, 200))")
    assert browser.eval("document.title") != "1"
    assert sum("Content Security Policy" in message for message in browser.messages) >= 3
