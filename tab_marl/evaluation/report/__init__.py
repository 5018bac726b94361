"""The report of an evaluation: one page that needs no network, tables for papers, figures, and films of episodes."""
