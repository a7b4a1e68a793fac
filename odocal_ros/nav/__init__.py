"""Earth, projection, rotations, strapdown, odometer, dead reckoning, standstills."""
