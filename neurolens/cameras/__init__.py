"""Cameras: pinhole, thin lens, exact lens and exported model behind one contract."""
