"""The paper's simulated and field experiments, and ours, as commands: published figures beside what comes out here."""
