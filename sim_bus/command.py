"""The simulators by kind, for ``python -m sim_bus`` and ``tdhil simulate``: each kind has its own options."""

import argparse
from collections.abc import Sequence

_KINDS = {
    "canopen": "a CiA 402 drive on a CAN bus",
    "ethercat": "a CiA 402 drive on EtherCAT (CoE)",
    "modbus": "a drive on Modbus TCP or RTU, described by a profile",
}


def add_kinds(parser: argparse.ArgumentParser) -> None:
    """Add a sub-command for each kind. The namespace gets the ``run`` of the selected one."""
    from sim_bus import canopen, ethercat, modbus

    kinds = parser.add_subparsers(dest="kind", required=True, metavar="KIND")
    for name, module in (("canopen", canopen), ("ethercat", ethercat), ("modbus", modbus)):
        kind = kinds.add_parser(name, help=_KINDS[name], description=f"Simulate {_KINDS[name]}.")
        module.add_arguments(kind)
        kind.set_defaults(run=module.run)


def main(argv: Sequence[str] | None = None) -> int:
    """Run ``python -m sim_bus KIND …``. Return the exit code."""
    parser = argparse.ArgumentParser(prog="python -m sim_bus", description="A simulated drive with a shaft on it.")
    add_kinds(parser)
    namespace = parser.parse_args(argv)
    return int(namespace.run(namespace))
