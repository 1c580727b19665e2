"""The plant on the motor: ``kind`` in plant.yaml selects it, and its callers use only `Plant`.

::

    plant = build(params)        state = plant.rest()        state = plant.step(state, torque, dt, load)

A state is an immutable tuple: keeping it is copying it. Each state has the motor's speed and angle.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import reduce
from operator import or_
from typing import TYPE_CHECKING, Annotated, Any, Protocol, TypeVar

from pydantic import BaseModel, PlainSerializer, PlainValidator

from profiles import refuse_if
from sim_bus.plant import rigid, two_mass
from sim_bus.plant.angle_torque import AngleTorque
from sim_bus.plant.drill_string import DrillString, StringParams
from sim_bus.plant.rigid import Params
from sim_bus.plant.two_mass import TwoMassParams


class MotorState(Protocol):
    """Common values of all states."""

    @property
    def speed_rad_s(self) -> float:
        """Speed of the motor's shaft, rad/s."""
    @property
    def angle_rad(self) -> float:
        """Angle of the motor's shaft, rad."""


class LoadedState(MotorState, Protocol):
    """Common values of the states with a load at the bottom."""

    @property
    def bottom_speed_rad_s(self) -> float:
        """Speed of the bottom, rad/s."""


S = TypeVar("S", bound=MotorState)


class Plant(Protocol[S]):
    """Any load of the motor."""

    def rest(self) -> S:
        """Return the state at standstill without twist."""
    def step(self, state: S, torque_nm: float, dt_s: float, load_nm: float = 0.0) -> S:
        """Return the state ``dt_s`` later, under constant torque and load at the motor."""


class Rigid:
    """`sim_bus.plant.rigid` as a `Plant`."""

    def __init__(self, params: Params) -> None:
        self.rest = rigid.ShaftState
        self.step = rigid.stepper(params)


class TwoMass:
    """`sim_bus.plant.two_mass` as a `Plant`."""

    def __init__(self, params: TwoMassParams) -> None:
        self.rest = two_mass.TwoMassState
        self.step = two_mass.stepper(params)


@dataclass(frozen=True)
class PlantKind:
    """Entry of one ``kind``: the model of its section in plant.yaml, its constructor, and whether it can twist."""

    params: type[BaseModel]
    plant: Callable[[Any], Plant[Any]]
    winds_up: bool = False


PLANTS: dict[str, PlantKind] = {
    "rigid": PlantKind(Params, Rigid),
    "two_mass": PlantKind(TwoMassParams, TwoMass, winds_up=True),
    "string": PlantKind(StringParams, DrillString, winds_up=True),
}
"""Every kind of plant. plant.yaml accepts these kinds, and the keys of their models."""


def build(params: Any) -> Plant[Any]:
    """Return the plant of ``params``, which are of one of `PLANTS`. A body on the motor's shaft is part of
    its inertia.
    """
    body = getattr(params, "added_inertia_kg_m2", 0.0)
    if body > 0.0:
        whole = params.inertia_kg_m2 + body
        params = params.model_copy(update={"inertia_kg_m2": whole, "added_inertia_kg_m2": 0.0})
    plant = PLANTS[params.kind].plant(params)
    harmonics = tuple(one for one in getattr(params, "harmonics", ()) if one.amplitude_nm > 0.0)
    return AngleTorque(plant.rest, plant.step, harmonics) if harmonics else plant


def _read(section: Any) -> Any:
    """Return the section as the model of its kind, rigid if it states none. Raises the errors of that model.

    A kind that does not exist, or a key of another kind, is refused by name.
    """
    if isinstance(section, tuple(kind.params for kind in PLANTS.values())):
        return section
    if not isinstance(section, dict):
        return PLANTS["rigid"].params.model_validate(section)
    kind = section.get("kind", "rigid")
    if not isinstance(kind, str) or kind not in PLANTS:
        *first, last = PLANTS
        shown = kind if isinstance(kind, str | int | float) else "a list or section"
        refuse_if([("kind", f"must be {', '.join(first)} or {last}, not {shown}")])
    foreign = {
        key: [other for other, one in PLANTS.items() if key in one.params.model_fields]
        for key in section if key not in PLANTS[kind].params.model_fields
    }
    refuse_if([(key, f"belongs to kind: {' or '.join(kinds)}, and this plant is {kind}")
               for key, kinds in foreign.items() if kinds])
    return PLANTS[kind].params.model_validate({"kind": kind, **section})


if TYPE_CHECKING:
    AnyPlantParams = Params | TwoMassParams | StringParams
else:
    _ANY = reduce(or_, (kind.params for kind in PLANTS.values()))
    AnyPlantParams = Annotated[_ANY, PlainValidator(_read), PlainSerializer(lambda one: one.model_dump())]
"""Type of the section ``plant`` of plant.yaml."""
