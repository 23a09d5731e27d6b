"""Publishers: one snapshot, many forms (Modbus, UDP datagrams, local stream)."""
