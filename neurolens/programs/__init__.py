"""The lens in other programs: Blender, Mitsuba, torch, compositing, browsers, and hosts that take rays."""
