"""Runs whose heads keep learning: trained, resumed, and tested without having been trained so."""

import numpy as np

import headway
from headway.training.methods import config_to_evaluate
from headway.training.run import RunDir
from headway.training.trainers import load_agent, make_trainer

LAST_LAYER = {"planner.adaptation": "last-layer"}


def test_a_run_of_frozen_heads_is_tested_with_heads_that_learn(two_iterations):
    frozen, learning = (
        headway.evaluate(two_iterations, groups=["train"], num_episodes=2, settings=settings)
        for settings in ({}, LAST_LAYER)
    )
    returns = [[row.episode_return for row in rows] for rows in (frozen, learning)]
    assert np.isfinite(returns).all()
    assert returns[0] != returns[1]


def test_the_prior_of_a_loaded_agent_comes_from_all_its_data(two_iterations):
    run = RunDir(two_iterations)
    config = config_to_evaluate(run.config(), LAST_LAYER)
    agent = load_agent(run, config)
    assert agent.model.prior.root.shape[0] == agent.model.net.num_members
    trainer = make_trainer(config)
    part = trainer.agent(trainer.load(run), run.load_data()[:1])
    assert (part.model.prior.noise != agent.model.prior.noise).all()
    assert load_agent(run).model.prior is None
