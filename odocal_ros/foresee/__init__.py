"""What a leg will tell while it is driven, on few of its rows; without ROS."""
