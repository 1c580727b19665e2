"""`tdhil serve`: rigs, runs and live pages in a browser, on this computer."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of serve."""
    from tdhil.service import HOST, PORT

    parser.add_argument("--rigs", type=Path, metavar="DIR",
                        help="a rig.yaml for each rig (default: two that are simulated)")
    parser.add_argument("--data", type=Path, metavar="DIR", default=Path("tdhil-data"),
                        help="where runs, audit and index go (default: tdhil-data)")
    parser.add_argument("--host", default=HOST, metavar="ADDRESS",
                        help=f"where to listen (default {HOST}; this computer only)")
    parser.add_argument("--port", type=int, default=PORT, metavar="N", help=f"default {PORT}; 0: any that is free")
    parser.add_argument("--viewer", action="append", metavar="ORIGIN", default=[],
                        help="where Foxglove or Lichtblick come from in a browser, such as http://localhost:8080:"
                        " that page may read logs as they grow, and nothing else; more than one by repeating it")
    parser.add_argument("--mqtt", metavar="URL",
                        help="tell a broker the rigs' states and results, mqtt[s]://host:port/prefix; user and password"
                        " from TDHIL_MQTT_USER and TDHIL_MQTT_PASSWORD_FILE (extra mqtt)")
    parser.add_argument("--check-idle", action="store_true",
                        help="serve nothing: exit 0 where no run of --data lives and no tdhil here holds a drive,"
                        " else 4 (before an upgrade)")
    parser.set_defaults(run=run)


def run(namespace: argparse.Namespace) -> int:
    """Until Ctrl-C or SIGTERM, which brake what moves."""
    from tdhil.service import check_idle, serve

    if not 0 <= namespace.port <= 65535:
        from tdhil.errors import UsageError

        raise UsageError("must be 0 to 65535", where=f"--port {namespace.port}")

    def say(text: str) -> None:
        print(text, file=sys.stderr, flush=True)  # noqa: T201

    if namespace.check_idle:
        return check_idle(namespace.data, say)
    viewers = frozenset(one.rstrip("/").lower() for one in namespace.viewer)
    return serve(namespace.rigs, namespace.data, namespace.host, namespace.port, say, viewers=viewers,
                 mqtt=namespace.mqtt)
