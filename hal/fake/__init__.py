"""Wire-true fake devices with encoders of their own, orderable faults and an injected clock."""
