"""HOKUYO scanning range finders: SCIP codec, session state machine, model facts, device clock, driver."""
