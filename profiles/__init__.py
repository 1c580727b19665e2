"""Drive profiles as data: the schema, a strict YAML loader, and what ships."""
