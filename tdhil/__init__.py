"""Identification of the moment of inertia of an inverter-driven machine, with its 95 % coverage interval.

The names below are the stable Python API; the command line uses the same functions. They are loaded at their first
use, so that ``import tdhil`` is fast.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from tdhil.version import __version__

if TYPE_CHECKING:
    from tdhil.api import CoastDown as CoastDown
    from tdhil.api import DriveHandle as DriveHandle
    from tdhil.api import Motion as Motion
    from tdhil.api import Multisine as Multisine
    from tdhil.api import Pulses as Pulses
    from tdhil.api import Result as Result
    from tdhil.api import RunRecord as RunRecord
    from tdhil.api import Sine as Sine
    from tdhil.api import Step as Step
    from tdhil.api import StopRequest as StopRequest
    from tdhil.api import identify as identify
    from tdhil.api import open_drive as open_drive
    from tdhil.api import read as read
    from tdhil.api import run as run
    from tdhil.api import simulate as simulate
    from tdhil.errors import TdhilError as TdhilError
    from tdhil.service import Client as Client

_API = (
    "CoastDown", "DriveHandle", "Motion", "Multisine", "Pulses", "Result", "RunRecord", "Sine", "Step", "StopRequest",
    "identify", "open_drive", "read", "run", "simulate",
)
__all__ = ["Client", "TdhilError", "__version__", *_API]  # noqa: PLE0604 - strings, by the line above


def __getattr__(name: str) -> Any:
    if name in _API:
        return getattr(import_module("tdhil.api"), name)
    if name == "Client":
        return import_module("tdhil.service").Client
    if name == "TdhilError":
        return import_module("tdhil.errors").TdhilError
    raise AttributeError(f"module 'tdhil' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted(__all__)
