"""The daemon: ties devices (`hal`) and numbers (`estimator`) into one asyncio process that publishes poses."""
