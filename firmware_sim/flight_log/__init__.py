"""The flight log of the vehicle: ULog (.ulg), as PX4 writes it."""
