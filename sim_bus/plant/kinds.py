"""Which plant hangs on the motor: ``kind`` in plant.yaml chooses, and whoever drives one sees only `Plant`.

::

    plant = build(params)        state = plant.rest()        state = plant.step(state, torque, dt, load)

A state is an immutable tuple: keeping it is copying it. The motor's speed and angle are in every one.
"""

from functools import partial
from typing import Annotated, Any, Protocol, TypeVar

from pydantic import BaseModel, BeforeValidator, Field

from profiles.model import refuse_if
from sim_bus.plant import rigid, two_mass
from sim_bus.plant.drill_string import DrillString, StringParams
from sim_bus.plant.rigid import Params
from sim_bus.plant.two_mass import TwoMassParams


class MotorState(Protocol):
    """What every state tells."""

    @property
    def speed_rad_s(self) -> float:
        """Of the motor's shaft."""
    @property
    def angle_rad(self) -> float:
        """Of the motor's shaft."""


S = TypeVar("S", bound=MotorState)


class Plant(Protocol[S]):
    """Anything that a motor turns."""

    def rest(self) -> S:
        """The state in which nothing turns and nothing is twisted."""
    def step(self, state: S, torque_nm: float, dt_s: float, load_nm: float = 0.0) -> S:
        """The state ``dt_s`` later, under constant torque and load at the motor."""


class Rigid:
    """`sim_bus.plant.rigid` as a `Plant`."""

    def __init__(self, params: Params) -> None:
        self.rest = rigid.State
        self.step = partial(rigid.step, params)


class TwoMass:
    """`sim_bus.plant.two_mass` as a `Plant`."""

    def __init__(self, params: TwoMassParams) -> None:
        self.rest = two_mass.TwoMassState
        self.step = partial(two_mass.step, params)


def build(params: Params | TwoMassParams | StringParams) -> Plant[Any]:
    """The plant that ``params`` describe."""
    if isinstance(params, TwoMassParams):
        return TwoMass(params)
    if isinstance(params, StringParams):
        return DrillString(params)
    return Rigid(params)


_KINDS: dict[str, type[BaseModel]] = {"rigid": Params, "two_mass": TwoMassParams, "string": StringParams}


def _rigid_unless_said(section: Any) -> Any:
    """Fills in ``kind``; a kind that does not exist, or a key of another kind, is refused by name."""
    if not isinstance(section, dict):
        return section
    kind = section.get("kind", "rigid")
    if not isinstance(kind, str) or kind not in _KINDS:
        shown = kind if isinstance(kind, str | int | float) else "a list or section"
        refuse_if([("kind", f"rigid, two_mass or string is wanted, not {shown}")])
    foreign = {
        key: [other for other, model in _KINDS.items() if key in model.model_fields]
        for key in section if key not in _KINDS[kind].model_fields
    }
    refuse_if([(key, f"belongs to kind: {' or '.join(kinds)}, and this plant is {kind}")
               for key, kinds in foreign.items() if kinds])
    return {"kind": kind, **section}


AnyPlantParams = Annotated[
    Params | TwoMassParams | StringParams, Field(discriminator="kind"), BeforeValidator(_rigid_unless_said)
]
"""The section ``plant`` of plant.yaml."""
