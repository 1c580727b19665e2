"""The CANopen face of the simulated drive: a CiA 402 node with its objects, PDOs and services, and scripted faults."""
