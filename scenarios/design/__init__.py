"""From a vehicle to a first good flight: what it can do, a controller and a course made for it, and its file."""
