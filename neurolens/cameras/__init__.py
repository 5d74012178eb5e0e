"""Cameras: pinhole, fisheye projections, thin and thick lens, exact lens and exported model behind one contract."""
