"""Data that can't be trusted, each fault recognised by a file of its own, with what would mend it."""
