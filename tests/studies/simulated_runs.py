"""Simulated studies by name, with their defaults except for the settings of a test."""

from tdhil.studies.registry import simulated_studies

STUDIES = {study.name: study for study in simulated_studies()}


def run(name, **settings):
    study = STUDIES[name]
    return study.run(study.settings_model(**settings), lambda share, what: None)
