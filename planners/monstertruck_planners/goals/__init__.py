"""Goals: from a pose that somebody asks for to standing there, or to a reason why not."""
