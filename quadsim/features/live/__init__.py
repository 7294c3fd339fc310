"""Interactive flights: user inputs are data, stamped with the control period at which they act."""
