"""Speed against accuracy on a user's own shot: methods and budgets measured, drawn and written out."""
