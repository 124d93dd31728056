"""What particles see of valves."""
