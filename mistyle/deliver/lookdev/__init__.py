"""`mistyle lookdev`: sheets and turntables of an asset."""
