"""The npm package `@foxglove/ws-protocol`, the client of the protocol: it receives the log byte for byte.

How to get it and run these: tests/peers/conftest.py.
"""

import json
import re
import subprocess
from base64 import b64decode

import pytest

from tests.path.path_runs import HANGS_S, process
from tests.service.conftest import wait_for
from tests.service.test_foxglove import by_topic, declared, logged
from tests.service.test_serve import QUICK, served

EACH_CYCLE = ("/sample", "/command", "/can")
"""Topics that a slow viewer loses."""


@pytest.mark.parametrize("protocol", ["foxglove.websocket.v1", "foxglove.sdk.v1"])
def test_the_client_of_the_protocol_receives_the_content_of_the_log(foxglove_program, tmp_path, protocol):
    """The client watches a simulated run from before its start to its result."""
    command, environment = foxglove_program("foxglove_client.mjs")
    data, said = tmp_path / "data", tmp_path / "said.txt"
    with served(data) as server, said.open("wb") as out:
        url = f"{server.url.replace('http', 'ws')}/foxglove/simulated-canopen"
        with process(*command, url, protocol, env=environment, stdin=subprocess.PIPE, stdout=out,
                     stderr=subprocess.PIPE) as client:
            wait_for("the channels", lambda: b"/modbus" in said.read_bytes())
            run = server.client.start("simulated-canopen", **QUICK)["id"]
            assert server.client.wait(run, timeout_s=HANGS_S)["state"] == "done"
            wait_for("the end", lambda: b"the run has ended" in said.read_bytes())
            client.stdin.close()
            assert client.wait(HANGS_S) == 0, client.stderr.read()
    told = [json.loads(line) for line in said.read_text().splitlines()]
    assert told[0] == {"open": protocol}
    path = data / "runs" / run / "run.mcap"
    channels = [one["channel"] for one in told if "channel" in one]
    assert {one["topic"]: (one["schemaName"], b64decode(one["schema"])) for one in channels} == declared(path)
    assert [one["info"]["sessionId"] for one in told if "info" in one] == ["no run", run]
    assert [one["info"]["name"] for one in told if "info" in one][1].endswith("SIMULATED")
    got = [(topic, int(time_ns), bytes.fromhex(data)) for topic, time_ns, data in (
        one["message"] for one in told if "message" in one)]
    wanted, statuses = logged(path), [one["status"] for one in told if "status" in one]
    print(f"{protocol}: {len(got)} of {len(wanted)} messages, {sum(len(payload) for *_, payload in got)} bytes")
    left_out = sum(int(re.search(r"too slow: (\d+) messages", text).group(1)) for level, text in statuses if level > 0)
    assert len(got) + left_out == len(wanted) > 10_000
    assert list(by_topic(got)) == list(by_topic(wanted))
    for topic, messages in by_topic(got).items():
        left = iter(by_topic(wanted)[topic])       # in their order; on a busy computer without the reported losses
        assert all(one in left for one in messages), topic
        assert len(messages) == len(by_topic(wanted)[topic]) or (left_out and topic in EACH_CYCLE)
