"""Material constants with their source: TPE and the two phases of the SMP."""
