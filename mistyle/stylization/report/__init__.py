"""The report of a stylization job: page, metrics, measures of the style picture."""
