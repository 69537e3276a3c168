"""Views of one surface that agree, beside EbSynth."""
