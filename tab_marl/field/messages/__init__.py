"""The passes over (automaton state, base state): where they go, how they are computed."""
