"""A run as it goes: runner, control loop, guard, stop; the stages, the excitations, and the design of the motion.

``tdhil.run(drive, motion)`` of the Python API bears the name of this room. Once anything of the room is loaded, the
attribute ``run`` of `tdhil` is the room, so the room can be called, and calls the API.
"""

import sys
from importlib import import_module
from types import ModuleType
from typing import Any


class _Room(ModuleType):
    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        # By name: the room knows nothing of what is above it, and whoever calls has it loaded anyway.
        return import_module("tdhil.api").run(*args, **kwargs)


sys.modules[__name__].__class__ = _Room
