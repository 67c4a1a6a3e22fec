"""Fuzzing of everything that is read: real datasets, runs, records, recipes, meshes, damaged by chance and by malice.

``python -m tests.fuzz`` runs cases, ``python -m tests.fuzz --case FAMILY:SEED`` one of them again. See SECURITY.md.

- :mod:`tests.fuzz.specimens` makes the real ones,
- :mod:`tests.fuzz.mutators` damages trees and bytes, :mod:`tests.fuzz.structures` what is in JSON, YAML, archives,
- :mod:`tests.fuzz.targets` reads them as people do,
- :mod:`tests.fuzz.watch` sees what a case does to files, processes, memory and time,
- :mod:`tests.fuzz.runner` puts these together and judges.
"""
