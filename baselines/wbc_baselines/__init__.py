"""Controllers that the bench is delivered with: clients of its public interface."""
