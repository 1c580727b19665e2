"""CANopen for scan, doctor and rig new."""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Any

from profiles import MessageCode
from tdhil.cli.scan_common import BusCommands, FoundDrive, ValueSeen

if TYPE_CHECKING:
    from profiles import Profile
    from tdhil.cli.doctor_finding import DoctorFinding
    from tdhil.config import Rig, RunOptions
    from tdhil.session import Connection, PeerPlan

LISTEN_S = 1.0


class CanopenCommands(BusCommands):
    """Scans every node of a bus; checks a drive by SDO."""

    address, address_flag = "node", "--node"
    to_fill_in = "bus and node"

    def add_scan_arguments(self, scan: argparse._ArgumentGroup) -> None:
        """Add the option for the listening time."""
        scan.add_argument("--listen", type=_seconds, default=LISTEN_S, metavar="S",
                          help=f"CANopen: how long to wait for answers and heartbeats (default {LISTEN_S:g} s)")

    def scan(
        self, plan: PeerPlan, connection: Connection, options: RunOptions, asked: argparse.Namespace
    ) -> tuple[tuple[FoundDrive, ...], list[str]]:
        """Return the nodes that answer SDO requests, and remarks on the others."""
        from drivers import CommunicationLost
        from tdhil.cli.buses.canopen_scan import ask_all, identify_all
        from tdhil.session.buses import canopen

        with canopen.open_can(plan, connection, canopen.node_of(options, connection)) as bus:
            link, heard = ask_all(bus, range(1, 128), asked.listen)
            found = identify_all(link, heard)
            heard.error_frames = link.error_frames
        silent = sorted(set(heard.states) - set(heard.device_types))
        remarks = [f"node {node} sends heartbeats ({heard.states[node]}) but answers no SDO request" for node in silent]
        if heard.error_frames:
            remarks.append(f"{heard.error_frames} error frames were received: check bit rate, termination and cable")
        if found:
            return found, remarks
        if heard.error_frames:
            what = f"no node answers, and {heard.error_frames} error frames were received"
            step = "The bit rate is most likely wrong (-b): compare it with the drives'; else termination or cable"
        elif heard.frames:
            what = f"no node answers, but {heard.frames} frames were received" + "".join(f"; {one}" for one in remarks)
            step = "Check with candump whether a drive is stopped by NMT, or the bus uses another protocol"
        else:
            what = "no node answers, and no frame was received"
            step = "Check that a drive is powered, the bit rate (-b), the cable and its termination (60 ohms)"
        raise CommunicationLost(what, where=link.name, next_step=step, entry=MessageCode.BUS_FAILED)

    def findings(
        self, plan: PeerPlan, connection: Connection, options: RunOptions, rig: Rig | None, seen: list[ValueSeen]
    ) -> Iterator[DoctorFinding]:
        """Yield findings on link or bit rate, adapter and drive."""
        from drivers import TdhilError
        from tdhil.cli.buses import canopen_doctor
        from tdhil.cli.doctor_finding import attempted, of_error, ok
        from tdhil.config import DriveData
        from tdhil.session.buses import canopen
        from tdhil.session.buses.can_bus import link_report

        profile, bus = canopen.profile_of(connection), canopen.config_of(connection)
        node = canopen.node_of(options, connection)
        if not plan.embedded and bus.interface == "socketcan" and bus.channel:
            found = attempted("link", lambda: canopen_doctor.link_findings(link_report(bus.channel), bus.channel))
            yield from found
            if found and found[-1].name == "link" and found[-1].grade == "bad":
                return                                     # the link does not exist: opening it would report the same
        elif not plan.embedded:
            yield canopen_doctor.rate_finding(bus.bitrate, bus.source("bitrate"))
        try:
            with canopen.open_can(plan, connection, node) as channel:
                yield ok("adapter", f"opened: {channel.channel_info}")
                data = rig.drive_data if rig is not None else DriveData()
                rated_nm = canopen.rated_torque_nm(plan, profile, data)
                yield from attempted("drive", lambda: canopen_doctor.drive_findings(channel, profile, node, rated_nm))
        except TdhilError as error:
            yield of_error("adapter", error)

    def wanted(self, connection: Connection, options: RunOptions) -> int | None:
        """Return the node of --node or rig.yaml."""
        return options.node

    def section(self, found: FoundDrive, connection: Connection) -> Mapping[str, Any]:
        """Return python-can's options in force."""
        settings = {name: setting.value for name, setting in connection.line.settings.items()}
        own = ("interface", "channel", "bitrate")
        simple = {name: value for name, value in settings.items() if isinstance(value, str | int | float | bool)}
        line: dict[str, Any] = {name: simple[name] for name in own if name in simple}
        more = {name: value for name, value in simple.items() if name not in own}
        return {**line, "options": more} if more else line

    def blank(self, profile: Profile) -> tuple[str, ...]:
        """Return blank lines for bus and node."""
        return ("#bus: {interface: socketcan, channel: can0, bitrate: 500k}    # python-can's own names",
                "#node:    # CANopen node number, 1 to 127")

    def keys(self, found: FoundDrive) -> Mapping[str, Any]:
        """Return the node."""
        return {"node": found.address}


def _seconds(text: str) -> float:
    from profiles.quantities import TIME
    from tdhil.cli.arguments import amount

    value = amount(TIME)(text)
    if not 0.0 < value <= 60.0:
        raise argparse.ArgumentTypeError(f"{text!r} is not a time from 0 to 60 s")
    return value


CANOPEN = CanopenCommands()
