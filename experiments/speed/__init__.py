"""How fast? Nanoseconds a ray, seconds a picture and tasks an hour on this machine."""
