"""Wire-true fake I2C converters and their bus, with orderable faults."""
