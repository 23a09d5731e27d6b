"""The cycle and what drives it: inbox, budget, scheduler, worker, warm-up."""
