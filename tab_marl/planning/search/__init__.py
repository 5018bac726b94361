"""Searches over histories: POMCP, DESPOT and POMCPOW, their trees, and the plans they return."""
