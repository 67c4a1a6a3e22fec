"""``dsffnet avatar``: a person in clothes, from posed scans to an animated mesh (FITE)."""
