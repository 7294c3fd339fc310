"""What the vehicle's sensors say of its motion: noise, bias, delay, dropouts, outliers and faults."""

from quadsim.sensing.sampler import Sample, Sampler, truth
from quadsim.sensing.sensor import AXES, FaultKind, Outliers, Sensor, SensorFault, SensorName

__all__ = ["AXES", "FaultKind", "Outliers", "Sample", "Sampler", "Sensor", "SensorFault", "SensorName", "truth"]
