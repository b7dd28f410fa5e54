"""A skill and a brain of another distribution: docs/adding-a-skill.md."""
