"""Live data of a growing log for a page: thinned, from its start, and with its age."""

from __future__ import annotations

import asyncio
import json
import time
from dataclasses import asdict
from types import SimpleNamespace

import numpy as np
import pytest
from starlette.testclient import TestClient
from starlette.websockets import WebSocketDisconnect

from drivers import CommunicationLost
from tdhil.cli.main import main
from tdhil.recording import LiveInertia, LogNews
from tdhil.service.limits import API
from tdhil.service.live_feed import EVERY_S, MOST, SPACING_S, Feed, LivePicture
from tdhil.service.run_state import Entered, State, Status
from tests.recording.test_log_tail import write
from tests.service.conftest import URL

LIVE = f"{URL.replace('http', 'ws')}{API}/live"


def news(first_s: float, count: int, every_s: float = 0.004, **more: object) -> LogNews:
    time_s = first_s + every_s * np.arange(count)
    return LogNews(np.column_stack((time_s, 0.1 * time_s, -time_s)), **more)


def test_it_is_thinned_for_any_size_of_parts():
    whole, pieces = LivePicture(), LivePicture()
    all_of_it = news(0.0, 1000)
    whole.take(all_of_it, 0.0)
    for k in range(0, 1000, 7):
        pieces.take(LogNews(all_of_it.samples[k:k + 7]), 0.0)
    assert np.array_equal(whole.samples, pieces.samples)
    assert np.diff(whole.samples[:, 0]).min() >= SPACING_S - 1e-9
    assert 90 <= len(whole.samples) <= 101


def test_a_long_run_stays_small_and_whole():
    picture = LivePicture()
    for k in range(60):
        picture.take(news(100.0 * k, 1000, 0.1), 0.0)
    assert len(picture.samples) <= MOST
    assert picture.samples[-1, 0] - picture.samples[0, 0] > 5900.0


def test_its_age_is_the_clock_s_or_in_stepped_time_that_of_its_arrival():
    real, stepped = LivePicture(), LivePicture()
    assert real.age_s(0.0, 0.0) is None
    real.take(news(0.0, 2, 1.0, epoch_ns=10**18), 5.0)
    assert real.age_s(10**9 + 3.5, 99.0) == pytest.approx(2.5)
    stepped.take(news(0.0, 2, 1.0, epoch_ns=10**18, configuration={"run": {"stepped": True}}), 5.0)
    assert stepped.age_s(10**9 + 3.5, 7.0) == pytest.approx(2.0)


def test_a_rehearsal_is_marked_for_every_viewer():
    picture = LivePicture()
    assert picture.whole()["rehearsed_faults"] == []
    run = {"run": {"faults": ["sto@hold+2s"]}}
    assert picture.take(news(0.0, 2, configuration=run), 0.0)["rehearsed_faults"] == ["sto@hold+2s"]
    assert "rehearsed_faults" not in picture.take(news(1.0, 2, configuration=run), 1.0)
    assert picture.whole()["rehearsed_faults"] == ["sto@hold+2s"]


def test_nan_is_null_in_json():
    picture = LivePicture()
    shown = picture.take(LogNews(np.array([[0.0, np.nan, np.inf]])), 0.0)
    assert json.dumps(shown, allow_nan=False)
    assert shown["samples"] == [[0.0], [None], [None]]


def test_j_during_the_run_has_every_digit_and_late_viewers_get_all_values():
    picture, found = LivePicture(), [LiveInertia(20.0 * k, k, 0.95, "valid", "", 104.0 + 1e-12 * k) for k in (1, 2)]
    for one in found:
        assert picture.take(LogNews(inertias=(one,)), 0.0)["inertias"] == [asdict(one)]
    assert json.loads(json.dumps(picture.whole()))["inertias"] == [asdict(one) for one in found]


def test_a_moving_run_is_notified_once_that_a_page_shows_it(tmp_path):
    told, state = [], ["preflight"]

    def tell():
        told.append(state[0])
        if len(told) == 1:
            raise CommunicationLost("not yet")

    feed = Feed(tmp_path / "run.mcap", lambda: SimpleNamespace(state=State(state[0])), tell)
    feed._look()
    state[0] = "moving"
    for _ in range(4):
        feed._look()
    assert told == ["moving", "moving"]


def test_a_viewer_that_returns_is_sent_no_old_state(tmp_path):
    """The page of an ended run used to accept the state "moving" as the present one, and then changed to the result."""
    states = [State.MOVING]
    feed = Feed(tmp_path / "run.mcap", lambda: Status("1", "a", (Entered(states[-1], ""),)))

    async def watched():
        queue = feed.watch()
        first = queue.get_nowait()["status"]
        news = await queue.get()
        feed.leave(queue)
        await asyncio.sleep(2.0 * EVERY_S)
        return first, news["status"]["state"]

    async def twice():
        found = [await watched()]
        states.append(State.DONE)
        return [*found, await watched()]

    assert asyncio.run(twice()) == [(None, "moving"), (None, "done")]


def test_a_viewer_gets_all_of_it_from_the_start(service):
    with TestClient(service.web.asgi, base_url=URL) as client:
        run = client.post(f"{API}/rigs/a/runs", json={"note": "hold"}).json()["id"]
        service.wait(run, "moving")
        (service.store.place(run) / "run.mcap").unlink(missing_ok=True)
        write(service.store.place(run) / "run.mcap")
        seen, events, states = [], [], []
        with client.websocket_connect(f"{LIVE}/{run}") as socket:
            end_s = time.monotonic() + 30.0
            while ("stopped" not in states or not events) and time.monotonic() < end_s:
                message = socket.receive_json()
                seen += message.get("samples", [[]])[0]
                events += [one["text"] for one in message.get("events", [])]
                if message.get("status"):
                    states.append(message["status"]["state"])
                if events and states[-1:] == ["moving"]:
                    client.post(f"{API}/runs/{run}/stop", json={})
                socket.send_text("nobody hears this")
        with client.websocket_connect(f"{LIVE}/{run}") as socket:
            assert socket.receive_json()["samples"][0] == seen
    assert events == ["half of it"]
    assert seen[0] == 0.0
    assert len(seen) >= 40


@pytest.mark.heavy
def test_the_last_live_value_of_a_whole_run_is_that_of_its_result(service, tmp_path, capsys):
    log = tmp_path / "run.mcap"
    assert main(["identify", "--simulate", "--seed", "7", "--max-time", "150", "--json", "--log", str(log)]) == 0
    result = json.loads(capsys.readouterr().out)["inertia_kg_m2"]
    with TestClient(service.web.asgi, base_url=URL) as client:
        run = client.post(f"{API}/rigs/a/runs", json={"note": "hold"}).json()["id"]
        service.wait(run, "moving")
        log.replace(service.store.place(run) / "run.mcap")
        shown, end_s = [], time.monotonic() + 30.0
        with client.websocket_connect(f"{LIVE}/{run}") as socket:
            while not shown and time.monotonic() < end_s:
                shown += socket.receive_json().get("inertias", [])
        client.post(f"{API}/runs/{run}/stop", json={})
    for key, live in (("value", "inertia_kg_m2"), ("low", "low_kg_m2"), ("high", "high_kg_m2"),
                      ("low_total", "low_total_kg_m2"), ("high_total", "high_total_kg_m2")):
        assert shown[-1][live] == pytest.approx(result[key], rel=1e-9)


class Gone:
    """WebSocket whose peer closes during a write."""

    def __init__(self, **names: str) -> None:
        self.path_params, self.scope = names, {"subprotocols": ["foxglove.sdk.v1"]}

    async def accept(self, protocol: str | None = None) -> None: ...

    async def receive(self) -> None:
        await asyncio.sleep(3600.0)

    async def send_text(self, text: str) -> None:
        raise WebSocketDisconnect(1006)

    send_bytes = send_text


@pytest.mark.parametrize("road", ["watch", "foxglove"])
def test_a_viewer_that_closes_during_a_message_is_no_error(service, road):
    run = service.supervisor.start_run("a", {}, "test").request.id
    asyncio.run(getattr(service.web, f"_{road}")(Gone(run=run, rig="a")))
    assert service.web.feeds.viewers == 0
