"""The page of symptoms lists every reason once, with a remedy."""

from pathlib import Path

from monstertruck_schemas.reasons import Reason

SITE = Path(__file__).resolve().parents[3] / "docs" / "site"


def test_every_reason_that_is_no_success_has_its_symptom(site_module):
    symptoms = site_module("symptoms")
    named = [name for symptom in symptoms.SYMPTOMS for name in symptom.reasons]
    assert len(named) == len(set(named))
    assert set(named) == {reason.value for reason in Reason if reason.exit_code}
    assert not [name for symptom in symptoms.SYMPTOMS for name, remedy in symptom.reasons.items() if not remedy]
    assert "what-to-do.md" in symptoms.page().uri
