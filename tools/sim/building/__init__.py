"""Buildings, their materials, people, and ray casting of a lidar in them."""
