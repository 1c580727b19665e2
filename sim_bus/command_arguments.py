"""Common parts of the commands of all simulated drives: options, signals, and a one-line message for an
error of use.
"""

import argparse
import contextlib
import math
import shutil
import signal
import sys
import threading
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING

from profiles import TdhilError

if TYPE_CHECKING:
    from sim_bus.params import RigParams

EXIT_OK = 0
EXIT_USAGE = 2
_UNWRAPPED = 1000         # columns


class Unusable(Exception):
    """An input of the user that can't be used. The text is the line to print."""


def add_drive_arguments(group: argparse._ArgumentGroup, fault: str, stepped: str) -> None:
    """Add the options of a CiA 402 drive with its shaft. ``fault``: an example of a fault; ``stepped``: help."""
    group.add_argument("--profile", metavar="NAME",
                       help="profile of the simulated drive: a name, or a .yaml file (default: tdhil's own EDS)")
    add_rig_arguments(group)
    add_fault_argument(group, fault)
    group.add_argument("--stepped", action="store_true", help=stepped)


def add_rig_arguments(group: argparse._ArgumentGroup) -> None:
    """Add the options of the shaft and of its trace."""
    group.add_argument("--plant", metavar="FILE", type=Path, help="YAML with other parameters of the rig")
    group.add_argument("--gains", metavar=("P", "I"), nargs=2, type=_gain,
                       help="gains of its speed loop, N·m·s/rad and N·m/rad at the motor; replace those of --plant")
    group.add_argument("--torque-scale", metavar="RATIO", type=_scale,
                       help="torque in the drive's own unit over true torque; replaces that of --plant")
    group.add_argument("--speed-scale", metavar="RATIO", type=_scale,
                       help="speed in the drive's own unit over true speed; replaces that of --plant")
    group.add_argument("--added-inertia", metavar="J", type=_gain,
                       help="body of known inertia on the motor's shaft, kg·m²; replaces that of --plant")
    group.add_argument("--seed", metavar="N", type=_seed, default=0, help="seed of all noise (default 0)")
    group.add_argument("--trace", metavar="FILE", type=Path, help="CSV file for the true motion of the shaft")


def rig_of(namespace: argparse.Namespace) -> "RigParams":
    """Return the rig of ``--plant``, changed by the other options. Raises DataFileError for a file that
    can't be used.
    """
    from sim_bus.params import RigParams, load_rig

    params = load_rig(namespace.plant) if namespace.plant is not None else RigParams()
    params = params.with_scales(namespace.torque_scale, namespace.speed_scale, namespace.added_inertia)
    if namespace.gains is None:
        return params
    gain, integral = namespace.gains
    own = {"speed_gain_nm_s_rad": gain, "speed_integral_gain_nm_rad": integral}
    return params.model_copy(update={"drive": params.drive.model_copy(update=own)})


def add_fault_argument(group: argparse._ArgumentGroup, such_as: str) -> None:
    """Add the option for scripted faults. Each bus has faults of its own."""
    group.add_argument("--fault", metavar="FAULT", action="append", default=[],
                       help=f"a scripted fault, such as {such_as}; repeatable; 'list' shows them all")


def printed_width() -> int:
    """Return the columns of the terminal on stdout; without one, a width at which no line of a list is wrapped."""
    return shutil.get_terminal_size().columns if sys.stdout.isatty() else _UNWRAPPED


def until_stopped(
    namespace: argparse.Namespace, listing: Callable[[int], str], simulate: Callable[[threading.Event], None]
) -> int:
    """Run ``simulate`` until SIGINT or SIGTERM. Return the exit code. An error of use ends with one line.

    For ``--fault list``, print the ``listing`` of the faults instead.
    """
    if "list" in namespace.fault:
        print(listing(printed_width()))  # noqa: T201
        return EXIT_OK
    stop = threading.Event()
    try:
        with _signals(stop):
            simulate(stop)
    except (Unusable, TdhilError, OSError) as error:
        print(f"simulate: {error}", file=sys.stderr)  # noqa: T201
        return EXIT_USAGE
    return EXIT_OK


def ready(text: str) -> None:
    """Print how to reach the simulator."""
    print(f"ready: {text}", flush=True)  # noqa: T201


def never_came(faults: Iterable[str]) -> None:
    """Print, at the end, the scripted faults that never occurred."""
    for fault in faults:
        print(f"simulate: the fault {fault} never came: its moment was not reached", file=sys.stderr)  # noqa: T201


def host_and_port(text: str) -> tuple[str, int]:
    """Return HOST and PORT of a text HOST:PORT. The default host is this computer."""
    host, colon, port = text.rpartition(":")
    if not colon or not port.isdigit() or int(port) > 65535:
        raise argparse.ArgumentTypeError(f"{text!r} is not HOST:PORT")
    return host.strip("[]") or "127.0.0.1", int(port)


def number_from(lowest: int, highest: int, what: str) -> Callable[[str], int]:
    """Return an argument type: a whole number in this range."""
    def parse(text: str) -> int:
        if not text.isdigit() or not lowest <= int(text) <= highest:
            raise argparse.ArgumentTypeError(f"{text!r} is not {what} from {lowest} to {highest}")
        return int(text)

    return parse


def _gain(text: str) -> float:
    with contextlib.suppress(ValueError):
        value = float(text)
        if math.isfinite(value) and value >= 0.0:
            return value
    raise argparse.ArgumentTypeError(f"{text[:40]!r} is not a gain: a number from 0")


def _scale(text: str) -> float:
    from sim_bus.params import SCALES

    with contextlib.suppress(ValueError):
        value = float(text)
        if SCALES[0] <= value <= SCALES[1]:
            return value
    raise argparse.ArgumentTypeError(f"{text[:40]!r} is not a ratio from {SCALES[0]:g} to {SCALES[1]:g}")


def _seed(text: str) -> int:
    if not text.isdigit():
        raise argparse.ArgumentTypeError(f"{text!r} is not a seed: a whole number from 0")
    return int(text)


@contextlib.contextmanager
def _signals(stop: threading.Event) -> Iterator[None]:
    """End the simulation on SIGINT and SIGTERM. Only the main thread can catch them."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def end(_number: int, _frame: FrameType | None) -> None:
        stop.set()

    before: dict[int, Callable[[int, FrameType | None], object] | int | None] = {}
    for number in (signal.SIGINT, signal.SIGTERM):
        before[number] = signal.signal(number, end)
    try:
        yield
    finally:
        for known, handler in before.items():
            signal.signal(known, handler)
