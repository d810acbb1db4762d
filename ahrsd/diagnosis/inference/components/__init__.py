"""What a recording may be made of: effects, courses, what recordings ordinarily leave."""
