"""The methods, their error budgets, their verdict, legs combined."""
