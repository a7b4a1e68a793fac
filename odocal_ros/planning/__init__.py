"""What a drive will tell before it is driven."""
