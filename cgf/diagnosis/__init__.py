"""Why two clouds did not register: findings in plain words, with evidence, and with the setting that mends each.

Measures (`measures`) come first, of the surfaces, of the features, and of the poses that matches agree on; then the
remedies that they suggest are tried on a sample of the points (`remedies`); `rules` judge both.
"""

from cgf.diagnosis.case import Case
from cgf.diagnosis.diagnose import diagnose, diagnose_result
from cgf.diagnosis.findings import Diagnosis, Evidence, Finding, Place
from cgf.diagnosis.loaded import diagnose_loaded

__all__ = ["Case", "Diagnosis", "Evidence", "Finding", "Place", "diagnose", "diagnose_loaded", "diagnose_result"]
