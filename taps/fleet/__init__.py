"""A fleet of robots over Zenoh: status of each robot, an overview on one map, distribution of survey and map."""
