"""What a configuration becomes: every YAML, the order of the layers, and replaying what another kind recorded."""

from __future__ import annotations

import dataclasses
import logging
import sqlite3
import sys
import time
from pathlib import Path
from types import ModuleType

import pytest
import yaml

from configs.compose import CONFIG_DIR
from configs.schema.backend import BackendConfig
from configs.validate import ConfigError, build
from proprio_mllm.backends.cache import CachedBackend, ReplayBackend
from proprio_mllm.backends.factory import SPENDING_FILE, make_backend
from proprio_mllm.backends.identity import identity_of
from proprio_mllm.backends.prices import price_of
from proprio_mllm.backends.protocol import BackendError, BackendSetupError, ChatReply, CostCapError
from proprio_mllm.backends.slots import SlottedBackend
from proprio_mllm.backends.spending import Spending
from tests.backends.loopback import KEY, Answering, Handler, LoopbackServer, ask, completion, finished, started

FILES = sorted((CONFIG_DIR / "backend").glob("*.yaml"))
#: What a user has to add.
NEEDS = {
    "vllm": {"model": "Qwen/Qwen2.5-VL-7B-Instruct"},
    "qwen2_5_vl": {"model": "Qwen2.5-VL-7B-Instruct"},
    "internvl2_5": {"model": "InternVL2_5-8B-hf"},
    "scripted": {"source": "answers.py:answer"},
}


def read(path: Path, **changes: object) -> BackendConfig:
    values = yaml.safe_load(path.read_text(encoding="utf-8"))
    missing = {name for name, value in values.items() if value == "???"}
    assert missing == set(NEEDS.get(path.stem, {}))
    return build(BackendConfig, {**values, **NEEDS.get(path.stem, {}), **changes})


def test_the_files() -> None:
    names = ["gemini", "gpt4o", "internvl2_5", "qwen2_5_vl", "scripted", "serve", "vllm"]
    assert [path.stem for path in FILES] == names


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_every_file(path: Path) -> None:
    cfg = read(path)
    assert cfg.name == path.stem
    assert path.read_text(encoding="utf-8").startswith("# ")
    if cfg.price is not None:
        assert cfg.model in price_of(cfg.price).models
    keys = [read(other).key_env for other in FILES if read(other).kind == "openai"]
    assert len(set(keys)) == len(keys), "a key goes to one server alone"


def test_gpt4o_needs_its_key(tmp_path: Path) -> None:
    with pytest.raises(BackendSetupError, match="backend gpt4o: no key; set the environment variable OPENAI_API_KEY"):
        make_backend(read(CONFIG_DIR / "backend" / "gpt4o.yaml"), tmp_path)
    with pytest.raises(BackendSetupError, match="GEMINI_API_KEY"):
        make_backend(read(CONFIG_DIR / "backend" / "gemini.yaml"), tmp_path)


def test_a_key_in_place_of_its_variable_is_refused_and_not_shown() -> None:
    with pytest.raises(ConfigError, match="key_env is the name of an environment variable") as caught:
        read(CONFIG_DIR / "backend" / "gpt4o.yaml", key_env=KEY)
    assert KEY not in str(caught.value)


@pytest.fixture
def gpt4o(server: LoopbackServer, tmp_path: Path, monkeypatch) -> BackendConfig:
    """The paper's model, as if this machine served it."""
    monkeypatch.setenv("OPENAI_API_KEY", KEY)
    cache = str(tmp_path / "replies.sqlite")
    return read(CONFIG_DIR / "backend" / "gpt4o.yaml", base_url=server.url, retries=0, timeout_s=5.0, cache=cache)


def test_a_recorded_reply_takes_no_slot_and_no_money(gpt4o: BackendConfig, server: LoopbackServer, tmp_path: Path) -> None:
    run = tmp_path / "run"
    backend = make_backend(gpt4o, run, cap_usd=1.0)
    first = backend.complete(ask())
    assert first.cost_usd == pytest.approx((100 * 2.5 + 10 * 10) * 1e-6)
    assert (run / "slots" / "gpt4o").is_dir()
    spending = Spending(run / SPENDING_FILE, None)
    spent = spending.total_usd()
    assert spent == pytest.approx(first.cost_usd)
    for path in (run / "slots" / "gpt4o").iterdir():
        path.unlink()
    assert backend.complete(ask()) == dataclasses.replace(first, cached=True)
    assert not list((run / "slots" / "gpt4o").iterdir())
    assert spending.total_usd() == spent
    assert len(server.asked) == 1
    backend.close()
    with pytest.raises(BackendError):
        backend.complete(ask("more"))


def test_replaying_what_was_recorded(gpt4o: BackendConfig, server: LoopbackServer, monkeypatch) -> None:
    backend = make_backend(gpt4o, None)
    first = backend.complete(ask())
    backend.close()
    monkeypatch.delenv("OPENAI_API_KEY")
    server.shutdown()
    replay = make_backend(dataclasses.replace(gpt4o, kind="replay", base_url=None), None, cap_usd=0.0)
    assert isinstance(replay, ReplayBackend)
    assert replay.identity == backend.identity == identity_of(gpt4o)
    assert replay.complete(ask()) == dataclasses.replace(first, cached=True)
    with pytest.raises(BackendError, match="holds no reply"):
        replay.complete(ask("other"))


def test_what_the_identity_depends_on(gpt4o: BackendConfig) -> None:
    same = {
        "base_url": None,
        "key_env": "OTHER",
        "kind": "replay",
        "name": "other",
        "retries": 9,
        "concurrency": 1,
        "price": None,
    }
    assert identity_of(dataclasses.replace(gpt4o, **same)) == identity_of(gpt4o)
    for change in ({"model": "m"}, {"revision": "r"}, {"structured": "off"}, {"constrained": True}, {"dtype": "float16"}):
        assert identity_of(dataclasses.replace(gpt4o, kind="replay", **change)) != identity_of(gpt4o)
    assert KEY not in identity_of(gpt4o)


def test_nothing_of_the_key_is_on_the_disk(gpt4o: BackendConfig, server: LoopbackServer, tmp_path: Path) -> None:
    server.answer = lambda handler: handler.send(200, completion(f"your key is {handler.headers['Authorization']}"))
    backend = make_backend(gpt4o, tmp_path / "run", 1.0)
    assert backend.complete(ask()).text == "your key is Bearer [key]"
    backend.close()
    files = [path for path in tmp_path.rglob("*") if path.is_file()]
    assert len(files) >= 3
    assert all(KEY.encode() not in path.read_bytes() for path in files)


def test_the_cap_stops_calls(gpt4o: BackendConfig, server: LoopbackServer, tmp_path: Path) -> None:
    backend = make_backend(gpt4o, tmp_path, cap_usd=0.001)
    with pytest.raises(
        CostCapError, match=r"backend gpt4o: a call of up to 0\.0\d+ USD might pass the cap: 0\.0000 of 0\.0010"
    ):
        backend.complete(ask())
    assert not server.asked
    with sqlite3.connect(tmp_path / "replies.sqlite") as connection:
        assert connection.execute("SELECT COUNT(*) FROM replies").fetchone() == (0,)


def test_a_cap_that_cannot_be_held(gpt4o: BackendConfig, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"cap_usd 1\.0 cannot be held without a run's folder"):
        make_backend(gpt4o, None, 1.0)
    unpriced = dataclasses.replace(gpt4o, price=None, base_url=None)
    with pytest.raises(ValueError, match=r"cap_usd 1\.0 cannot be held: backend\.price of gpt4o is null"):
        make_backend(unpriced, tmp_path, 1.0)
    make_backend(dataclasses.replace(unpriced, base_url=gpt4o.base_url), tmp_path, 1.0).close()


def test_prices_of_other_models(gpt4o: BackendConfig, tmp_path: Path, caplog) -> None:
    with pytest.raises(ValueError, match=r"backend\.price='cheap' is not allowed"):
        make_backend(dataclasses.replace(gpt4o, price="cheap"), tmp_path)
    with caplog.at_level(logging.WARNING):
        make_backend(dataclasses.replace(gpt4o, model="gpt-9"), tmp_path).close()
    assert "backend gpt4o: model gpt-9 is priced as gpt-4o-2024-08-06" in caplog.text


def test_what_was_made_is_closed_when_the_rest_fails(gpt4o: BackendConfig, tmp_path: Path, monkeypatch) -> None:
    inner = Answering()
    monkeypatch.setattr("proprio_mllm.backends.factory._model", lambda cfg: inner)
    (tmp_path / "replies.sqlite").write_text("damaged" * 1000)
    with pytest.raises(BackendSetupError, match="is damaged"):
        make_backend(gpt4o, tmp_path)
    assert inner.closed


ASKING = """
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from configs.schema.backend import BackendConfig
from proprio_mllm.backends.factory import make_backend
from proprio_mllm.backends.protocol import ChatMessage, ChatRequest
url, run, name = sys.argv[1:]
cfg = BackendConfig("openai", "tested", model="m", base_url=url, concurrency=3, cache=f"{run}/replies.sqlite")
backend = make_backend(cfg, Path(run))
requests = [ChatRequest((ChatMessage("user", (f"{name} {number}",)),)) for number in range(15)]
with ThreadPoolExecutor(6) as pool:
    print(sum(reply.text == "ok" for reply in pool.map(backend.complete, requests)))
backend.close()
"""


def test_no_more_calls_at_once_than_allowed_over_threads_and_processes(server: LoopbackServer, tmp_path: Path) -> None:
    now, most = 0, 0

    def slow(handler: Handler) -> None:
        nonlocal now, most
        with server.lock:
            now += 1
            most = max(most, now)
        time.sleep(0.02)
        with server.lock:
            now -= 1
        handler.send(200, completion("ok"))

    server.answer = slow
    assert finished(*(started(ASKING, server.url, tmp_path, name) for name in "ab")) == ["15\n", "15\n"]
    assert len(server.asked) == 30
    assert most == 3


def test_scripted(tmp_path: Path) -> None:
    (tmp_path / "answers.py").write_text("def answer(request): return 'Wait()'\n")
    cfg = read(CONFIG_DIR / "backend" / "scripted.yaml", source=f"{tmp_path / 'answers.py'}:answer")
    backend = make_backend(cfg, None)
    assert isinstance(backend, SlottedBackend)
    assert backend.complete(ask()).text == "Wait()"
    backend.close()
    cached = make_backend(dataclasses.replace(cfg, cache=str(tmp_path / "replies.sqlite")), None)
    assert isinstance(cached, CachedBackend)
    assert [cached.complete(ask()).cached for _ in range(2)] == [False, True]


def test_local(tmp_path: Path, monkeypatch) -> None:
    module = ModuleType("proprio_mllm.backends.local")
    made = []

    def local_chat(cfg: BackendConfig) -> Answering:
        made.append(cfg)
        return Answering(identity_of(cfg), lambda request: ChatReply("from here"))

    module.LocalChat = local_chat  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, module.__name__, module)
    cfg = read(CONFIG_DIR / "backend" / "qwen2_5_vl.yaml", cache=str(tmp_path / "replies.sqlite"))
    backend = make_backend(cfg, tmp_path, cap_usd=0.0)  # costs nothing
    assert backend.complete(ask()).text == "from here"
    assert made == [cfg]
    replay = make_backend(dataclasses.replace(cfg, kind="replay"), None)
    assert replay.complete(ask()).cached


def test_a_script_needs_neither_the_client_nor_torch(tmp_path: Path) -> None:
    code = "import sys, proprio_mllm.backends.factory\nprint(sorted({'openai', 'httpx2', 'torch'} & set(sys.modules)))"
    assert finished(started(code)) == ["[]\n"]
