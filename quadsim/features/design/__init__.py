"""From a vehicle to a first good flight: its limits, a controller and a course for it, and the scenario file."""
