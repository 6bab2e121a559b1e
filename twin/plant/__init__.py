"""The simulated cell. The only package that imports MuJoCo."""

import os

# Cameras render off screen, with a display or without; MuJoCo reads this when first imported.
os.environ.setdefault("MUJOCO_GL", "egl")
