"""What a solved field tells: evidence, paths, stages, files, pictures."""
