"""A wire-true fake HOKUYO lidar with orderable faults."""
