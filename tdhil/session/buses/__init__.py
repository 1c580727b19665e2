"""What is particular to CANopen and to Modbus in reaching a drive: where it is, and how it is opened."""
