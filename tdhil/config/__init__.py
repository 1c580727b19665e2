"""What a run is told: rig.yaml, and every option with where its value came from."""
