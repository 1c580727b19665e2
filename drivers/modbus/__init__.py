"""A drive on Modbus, over TCP or a serial line (RTU): links, the pure codec, and the `ModbusDrive`."""
