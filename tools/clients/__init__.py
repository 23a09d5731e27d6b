"""Reference clients: short, on their own, written from docs/modbus.md and docs/udp.md alone. Copy them freely."""
