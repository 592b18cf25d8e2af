# Everything runs in .venv, which the first command makes.
.PHONY: help setup demo test lint types unit
.DEFAULT_GOAL := help

BIN := .venv/bin
export LP_NUM_THREADS ?= 1

help: ## Show this list
	@awk -F ':.*## ' '/^[a-z]+:.*## /{printf "  make %-8s %s\n", $$1, $$2}' $(MAKEFILE_LIST)

setup: ## Install what the other commands need (they do it themselves)
	@bash tools/setup.sh

demo: setup ## Every stage on a small set, ends with a table and a report
	@$(BIN)/vd4rl-pomdp demo

test: lint types unit ## Lint, format, types and tests

lint: setup ## Format and lint checks
	@$(BIN)/ruff format --check --quiet . || { $(BIN)/ruff format --check .; exit 1; }
	@$(BIN)/ruff check --quiet .

types: setup ## Type checks
	@$(BIN)/mypy

unit: setup ## Tests, on two processes
	@bash tools/setup.sh tests
	@OMP_NUM_THREADS=1 $(BIN)/python -m pytest -q -n 2 --dist worksteal
