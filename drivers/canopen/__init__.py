"""CiA 402 drives on CANopen: state machine, objects, I/O."""
