"""A flight that a person is part of: inputs are data, stamped with the control period at which they act."""
