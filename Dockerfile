# docker build -t wfsobs . && docker run --rm -p 5006:5006 wfsobs
# Behind a proxy: docker run ... wfsobs wfsobs serve --address 0.0.0.0 --public --origin ao.example.org (docs/serving.md)

FROM python:3.13-slim AS build
COPY . /src
WORKDIR /src
RUN python -m venv /opt/wfsobs \
    && /opt/wfsobs/bin/pip install --no-cache-dir -r requirements.txt \
    && /opt/wfsobs/bin/pip wheel --no-build-isolation --no-deps --wheel-dir /dist . \
    && /opt/wfsobs/bin/pip install --no-cache-dir --no-deps /dist/*.whl \
    && /opt/wfsobs/bin/pip check

FROM python:3.13-slim
COPY --from=build /opt/wfsobs /opt/wfsobs
ENV PATH=/opt/wfsobs/bin:$PATH OPENBLAS_NUM_THREADS=1 PYTHONUNBUFFERED=1 PYTHONDONTWRITEBYTECODE=1
RUN useradd --create-home wfsobs
USER wfsobs
WORKDIR /home/wfsobs

# An image that cannot run the observers, or load the dashboard, is not built.
RUN wfsobs run --set run.duration=2 --json >/dev/null && python -c "import wfsobs.app.serve"

EXPOSE 5006
HEALTHCHECK --start-period=30s --timeout=10s \
    CMD python -c "from urllib.request import urlopen; urlopen('http://localhost:5006/liveness', timeout=5)"
CMD ["wfsobs", "serve", "--address", "0.0.0.0", "--public"]
