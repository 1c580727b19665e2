"""Recording in, Identification out; pure numpy and scipy, knows no drive and no file."""
