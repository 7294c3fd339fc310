"""`quadsim export`: a scenario's controller as C99, with the flight that it was recorded on."""
