"""What the vehicle's sensors say of its motion: noise, bias, delay, dropouts, outliers and faults."""
