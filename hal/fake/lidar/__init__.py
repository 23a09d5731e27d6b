"""A simulated HOKUYO lidar that matches SCIP byte for byte, with fault injection."""
