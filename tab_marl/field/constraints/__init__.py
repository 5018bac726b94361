"""Constraints beyond the mission: what they watch, their multipliers, and whether they can hold together."""
