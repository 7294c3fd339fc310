"""What flies a vehicle: a controller, its guard, the faster loop around it, and control allocation."""
