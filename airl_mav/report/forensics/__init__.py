"""Why a flight failed, or took long: causes worked out from what was recorded."""
