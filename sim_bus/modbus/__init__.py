"""The Modbus face of the simulated drive: it wears a profile, over the same inverter and shaft as the CANopen face.

`families` says what words do, from the manuals · `layout`, `bank`: which number stands where · `machine`: the drive
without its bus · `embedded`: in the host's own time · `server`: on TCP or a serial line, in real time.
"""
