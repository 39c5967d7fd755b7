# Thin over ci/: every target is one script, which can be run alone where make is absent (bash ci/demo.sh).
.PHONY: help demo test test-all setup doctor format clean

help:
	@echo "make demo     all set-up, then the main job: softtwin quickstart"
	@echo "make test     all set-up, then the checks and tests that CI runs"
	@echo "make test-all these, the slow tests, a second DOLFINx, and the suites without FEniCSx: before a release"
	@echo "make setup    system packages, .venv, the project"
	@echo "make doctor   what is installed, which versions, which BLAS, GPU or not"
	@echo "make format   ruff puts the source in order"
	@echo "make clean    removes the virtual environments and all caches"

demo:
	@bash ci/demo.sh

test:
	@bash ci/test.sh

test-all:
	@bash ci/test.sh --all

setup:
	@bash ci/setup.sh

doctor: setup
	@.venv/bin/softtwin doctor

format: setup
	@.venv/bin/ruff format . && .venv/bin/ruff check --fix .

clean:
	rm -rf .venv .venv-bare* .venv-011 build softtwin.egg-info .mypy_cache .ruff_cache .pytest_cache .import_linter_cache
