"""fab4d: from two shapes of one object to print files and a rig sheet for 4D printing."""

__version__ = "0.1.0"
