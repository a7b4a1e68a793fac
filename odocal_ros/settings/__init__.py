"""What may be set, its limits and defaults; Imu grades."""
