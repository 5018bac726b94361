"""Where episodes are played: processes of this machine (`local`), or a Ray cluster (`cluster`). The rows are the same."""
