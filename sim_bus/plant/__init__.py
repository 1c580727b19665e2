"""The shaft that the simulated drive turns: rigid, of two masses, or with a drill string; with its dry friction."""

from sim_bus.plant.batch import (
    FixedStep as FixedStep, LARGEST_BRISTLE_STEP as LARGEST_BRISTLE_STEP, SPEED as SPEED, Shafts as Shafts,
    white_torque as white_torque,
)
from sim_bus.plant.angle_torque import AngleTorque as AngleTorque
from sim_bus.plant.friction import Harmonic as Harmonic
from sim_bus.plant.kinds import (
    AnyPlantParams as AnyPlantParams, LoadedState as LoadedState, MotorState as MotorState, PLANTS as PLANTS,
    build as build,
)
from sim_bus.plant.rigid import Params as Params, ShaftState as ShaftState
