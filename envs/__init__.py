"""The environments: bodies, arenas and tasks, one readable file each."""

import warnings

# dm_control looks for a display when it is imported; nothing here opens a window.
warnings.filterwarnings("ignore", message=r".*X11: The DISPLAY", module="glfw")
