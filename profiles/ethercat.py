"""Schema of an EtherCAT drive's profile: entries of CiA 402, which apply to any bus, and entries of CoE.

Data only. Each section carries its ``source`` and its ``confidence``, because a profile is only as good as its sources.
"""

from typing import Literal, Self

from pydantic import Field, model_validator

from profiles.cia402 import Cia402Profile, Cycle, HostWatchdog, Index
from profiles.model import refuse_if

__all__ = ["Cyclic", "EthercatProfile", "Watchdog"]


class Watchdog(HostWatchdog):
    """Means that stops the drive when the host is silent."""

    kind: Literal["sync_manager", "none"] = Field(
        description="sync_manager: the watchdog of the process data, registers 0400h and 0420h of the slave controller"
    )


class Cyclic(Cycle):
    """The cycle of setpoints and feedback."""

    rx_pdos: tuple[Index, ...] = Field(
        default=(0x1600,), min_length=1, description="RxPDOs (setpoints) that are assigned in 1C12h"
    )
    tx_pdos: tuple[Index, ...] = Field(
        default=(0x1A00,), min_length=1, description="TxPDOs (feedback) that are assigned in 1C13h"
    )
    fixed: bool = Field(
        default=False, description="true: the content of these PDOs can't be changed; it is read from the drive"
    )
    distributed_clocks: bool = Field(
        default=True, description="use SYNC0 of the distributed clocks where the slave controller has them"
    )

    @model_validator(mode="after")
    def _one_to_fill(self) -> Self:
        if not self.fixed and (len(self.rx_pdos) > 1 or len(self.tx_pdos) > 1):
            refuse_if([("fixed", "several PDOs are assigned only with their own content; give fixed: true")])
        return self


class EthercatProfile(Cia402Profile):
    """One drive on EtherCAT."""

    bus: Literal["ethercat"]
    watchdog: Watchdog
    cyclic: Cyclic
