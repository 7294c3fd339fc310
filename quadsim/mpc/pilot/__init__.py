"""What flies a vehicle: a law, its guard, the faster loop around it, and control allocation."""
