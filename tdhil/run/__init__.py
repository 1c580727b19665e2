"""The five stages, their order, the guard over every command and sample, the excitations."""
