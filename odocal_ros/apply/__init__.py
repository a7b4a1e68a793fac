"""A calibration at work: counter and Imu in, pose and twist with their covariance out."""
