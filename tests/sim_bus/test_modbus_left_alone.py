"""Simulated Modbus drive whose host ends in motion: its watchdog stops the shaft, and the trace shows it."""

from tests.sim_bus.modbus_host import GenericHost, drive


def test_it_continues_until_its_watchdog_has_stopped_the_shaft() -> None:
    host = GenericHost(drive())
    host.write_one(40, 500)                                        # time-out, ms
    host.enable(20.0)
    host.cycles(8.0, rpm=20.0)
    assert host.drive.speed_rad_s > 1.0
    left_s = host.drive.time_s
    host.drive.run_on()
    assert abs(host.drive.speed_rad_s) < 0.01
    assert 1.0 < host.drive.time_s - left_s < 30.0
    again_s = host.drive.time_s
    host.drive.run_on()
    assert host.drive.time_s - again_s < 1.5                       # already at standstill
