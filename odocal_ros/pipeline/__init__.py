"""From a leg to its result, pure: prepare, align, reckon, methods, check, combination."""
