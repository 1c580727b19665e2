"""The commands, each put together from the rooms; `tdhil.cli` chooses among them."""
