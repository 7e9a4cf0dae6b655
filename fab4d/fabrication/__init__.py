"""From an SMP density per tet to labels and watertight bodies that can be printed."""
