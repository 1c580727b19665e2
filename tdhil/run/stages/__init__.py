"""The five stages of a run (section 5.1 of the paper), and the brake test that may come before the third."""
