"""The paper's simulated experiments: tables, figures and sweeps beside what it published."""
