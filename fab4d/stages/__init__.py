"""One module and one `run` per stage of pipeline/stages.toml; each composes the rooms below."""
