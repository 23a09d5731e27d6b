"""Publishers: one snapshot, many forms (Modbus, UDP datagrams)."""
