"""From the tables of a scenario file to the parts that fly: vehicle, effects, sensors, controllers."""
