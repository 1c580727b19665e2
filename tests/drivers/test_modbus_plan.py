"""Plan of transactions for registers: the smallest number, without access to other registers."""

import copy
import itertools

import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.errors import PreflightRefused
from drivers.modbus.cycle import RegisterSpan, plan_cycle, spans
from profiles.library import load_modbus_profile
from profiles.modbus import ModbusProfile, Register

GENERIC = load_modbus_profile("generic/modbus").model_dump(by_alias=True)
WHENCE = {"source": "made up for a test", "confidence": "unverified"}


def profile(*, control=0, speed_setpoint=1, torque_setpoint=3, status=16, speed=17, torque=19, demand=None,
            wide=False, mode=None, display=None, **cycle):
    """Return generic/modbus with another map."""
    data = copy.deepcopy(GENERIC)

    def signal(address, **more):
        kind = "i32" if wide else "i16"
        return {"register": {"address": address, "type": kind}, "per_lsb": 1.0, "unit": "rpm", **WHENCE, **more}

    def word(address):
        return {"register": {"address": address, "type": "u16"}, **WHENCE}

    data["cycle"] |= {
        "control": word(control), "status": word(status), "speed_setpoint": signal(speed_setpoint),
        "torque_setpoint": signal(torque_setpoint), "speed": signal(speed), "torque": signal(torque),
        "torque_demand": None if demand is None else signal(demand), **cycle,
    }
    none = {"register": None, "speed_value": None, "torque_value": None, "display": None}
    data["modes"] |= {"by": "control_bits", **none}
    if mode is not None:
        data["modes"] |= {"by": "register", "register": {"address": mode}, "speed_value": 0, "torque_value": 1}
    if display is not None:
        data["modes"]["display"] = {"register": {"address": display}, "speed": 0, "torque": 1}
    return ModbusProfile.model_validate(data)


def texts(transactions):
    return [str(one) for one in transactions]


def test_the_generic_drive_takes_one_transaction():
    plan = plan_cycle(load_modbus_profile("generic/modbus"))
    assert texts(plan.cycle) == ["23 writes 0+5 reads 16+5"]
    assert plan.mode_writes == plan.mode_reads == ()
    image = dict(enumerate([0x000F, 0xFFFF, 0xFF9C, 250, 1]))
    assert plan.cycle[0].request(image).hex(" ") == "17 00 10 00 05 00 00 00 05 0a 00 0f ff ff ff 9c 00 fa 00 01"


def test_classic_words_side_by_side():
    """ABB's classic layout has three output words and three input words."""
    layout = {"control": 0, "speed_setpoint": 1, "torque_setpoint": 2, "status": 3, "speed": 4, "torque": 5}
    assert texts(plan_cycle(profile(**layout, functions=(3, 6, 16, 23))).cycle) == ["23 writes 0+3 reads 3+3"]
    assert texts(plan_cycle(profile(**layout, functions=(3, 6, 16))).cycle) == ["16 writes 0+3", "3 reads 3+3"]


def test_scattered_registers():
    """The setpoint comes before the control word, a gap may be read too, and speed and torque come last."""
    layout = {"control": 8501, "speed_setpoint": 8602, "torque_setpoint": 8603, "status": 3201, "speed": 8604,
              "torque": 3226}
    plain = plan_cycle(profile(**layout, functions=(3, 6, 16), largest_gap=30))
    assert texts(plain.cycle) == ["16 writes 8602+2", "6 writes 8501+1", "3 reads 3201+26", "3 reads 8604+1"]
    both = plan_cycle(profile(**layout, functions=(3, 6, 16, 23), largest_gap=30))
    assert texts(both.cycle) == ["23 writes 8602+2 reads 3201+26", "23 writes 8501+1 reads 8604+1"]
    apart = plan_cycle(profile(**layout, functions=(3, 6, 16), largest_gap=0))
    assert texts(apart.cycle)[2:] == ["3 reads 3201+1", "3 reads 3226+1", "3 reads 8604+1"]


def test_optional_registers_are_read_only_if_that_costs_no_request():
    free = plan_cycle(profile(mode=4, display=20, demand=21, torque_setpoint=3, speed_setpoint=2, control=1,
                              status=17, speed=18, torque=19))
    assert texts(free.cycle) == ["23 writes 1+4 reads 17+5"]
    assert free.has_demand
    dear = plan_cycle(profile(mode=40, display=50, demand=60))
    assert len(dear.cycle) == 2 and not dear.has_demand
    assert texts(dear.mode_writes) == ["6 writes 40+1"]
    assert texts(dear.mode_reads) == ["3 reads 50+1"]


def test_input_registers_are_read_with_function_4():
    data = profile(functions=(3, 4, 6, 16, 23)).model_dump(by_alias=True)
    for name in ("status", "speed", "torque"):
        data["cycle"][name]["register"]["table"] = "input"
    plan = plan_cycle(ModbusProfile.model_validate(data))
    assert texts(plan.cycle)[-2:] == ["4 reads 16+2", "4 reads 19+1"]


def test_half_a_number_is_never_written():
    with pytest.raises(PreflightRefused, match="in one request"):
        plan_cycle(profile(wide=True, speed_setpoint=1, torque_setpoint=3, speed=17, torque=19, functions=(3, 6)))


def test_a_drive_without_writable_registers():
    with pytest.raises(PreflightRefused, match="can't be written"):
        plan_cycle(profile(functions=(3,)))


@st.composite
def layouts(draw):
    wide = draw(st.booleans())
    step = 2 if wide else 1
    places = draw(st.lists(st.integers(0, 60), min_size=8, max_size=8, unique=True))
    names = ("control", "speed_setpoint", "torque_setpoint", "status", "speed", "torque", "mode", "display")
    functions = draw(st.sampled_from([(3, 6, 16), (3, 16), (3, 6, 16, 23), (3, 23)]))
    gap = draw(st.integers(0, 10))
    largest = draw(st.integers(4, 30))
    return profile(**{name: step * place for name, place in zip(names, places, strict=True)}, wide=wide,
                   functions=functions, largest_gap=gap, largest_read=largest)


@given(layouts())
def test_any_layout(made):
    plan, cycle, modes = plan_cycle(made), made.cycle, made.modes
    asked = [cycle.speed_setpoint.register_, cycle.torque_setpoint.register_, cycle.control.register_, modes.register_]
    wanted = [cycle.status.register_, cycle.speed.register_, cycle.torque.register_]
    addresses = {one.address + k for one in asked for k in range(one.count)}
    written = [one.write for one in (*plan.cycle, *plan.mode_writes) if one.write is not None]
    covered = [span.address + k for span in written for k in range(span.length)]
    assert sorted(covered) == sorted(addresses)                 # each once, and no other register
    reads = [one.read for one in plan.cycle if one.read is not None]
    assert all(any(span.covers(register) for span in reads) for register in wanted)
    assert all(span.length <= cycle.largest_read for span in reads)
    assert all(one.function in cycle.functions for one in (*plan.cycle, *plan.mode_writes, *plan.mode_reads))
    order = [k for k, one in enumerate(plan.cycle) for register in asked[:3]
             if one.write is not None and one.write.covers(register) and register is asked[2]]
    setpoints = [k for k, one in enumerate(plan.cycle) for register in asked[:2]
                 if one.write is not None and one.write.covers(register)]
    assert max(setpoints) <= order[0]
    if modes.display is not None and not plan.mode_reads:
        assert any(span.covers(modes.display.register_) for span in reads)


@given(st.lists(st.tuples(st.integers(0, 40), st.sampled_from(["i16", "i32"])), min_size=1, max_size=6),
       st.integers(0, 5), st.integers(2, 12))
def test_no_smaller_number_of_spans_is_possible(drawn, gap, most):
    registers, free = [], 0
    for skip, kind in drawn:
        registers.append(Register(address=free + skip, type=kind))
        free = registers[-1].address + registers[-1].count
    found = spans(registers, gap, most)

    def possible(cuts):
        groups = [registers[a:b] for a, b in itertools.pairwise((0, *cuts, len(registers)))]
        return all(
            group[-1].address + group[-1].count - group[0].address <= most
            and all(b.address - a.address - a.count <= gap for a, b in itertools.pairwise(group))
            for group in groups
        )

    fewest = next(count for count in range(len(registers))
                  if any(possible(cuts) for cuts in itertools.combinations(range(1, len(registers)), count)))
    assert len(found) == fewest + 1
    assert found == sorted(set(found))
    assert isinstance(found[0], RegisterSpan)
