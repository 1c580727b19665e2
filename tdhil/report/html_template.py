"""The report's page, for jinja2. Everything it shows is in the result document; nothing is loaded from elsewhere."""

TEMPLATE = """<!DOCTYPE html>
<html lang="en"><head><meta charset="utf-8">
<title>Moment of inertia{% if d.simulated %} ({{ simulated }}){% endif %}</title>
<meta name="viewport" content="width=device-width">
<style>
{{ style }}
.banner { background: #a21caf; color: #fff; padding: .6rem 1rem; font-weight: 700; letter-spacing: .05em }
.answer { border-left: .5rem solid; padding: .2rem 1rem; margin: 1.2rem 0 }
.answer.green { border-color: #1a7f37 } .answer.yellow { border-color: #8a6100 } .answer.red { border-color: #b42318 }
.big { font-size: 2.4rem; line-height: 1.2; font-weight: 700; color: #222; margin: .2rem 0 }
.half { font-size: 1.2rem; color: #444; margin: .2rem 0 }
.answer p { color: #222 } .answer p.verdict { font-weight: 700; color: inherit }
.warn { background: #fff8e6; border-left: .25rem solid #8a6100; padding: .3rem .8rem; margin: .4rem 0 }
td.text, th.text { text-align: left }
figure { margin: .5rem 0 } figcaption { color: #555; max-width: 54rem }
@media print { body { margin: 0 auto; font-size: 12px } h2 { break-after: avoid } figure { break-inside: avoid } }
</style></head><body>
{% if d.simulated %}<div class="banner">{{ simulated }}: drive and rig are simulated, nothing real turned</div>\
{% endif %}

<h1>Moment of inertia at the motor shaft</h1>
<div class="answer {{ colour }}">
{% if d.inertia_kg_m2 %}{% set j = d.inertia_kg_m2 %}
<p class="big">{{ "J_r" if d.compliant else "J" }} = {{ total(j) }}</p>
{% if d.compliant %}<p class="half">of a compliant shaft's motor side; J_r + J_L \
{% if d.compliant.total_inertia_kg_m2 %}= {{ interval(d.compliant.total_inertia_kg_m2, "kg·m²") }}\
{% else %}left open by the data{% endif %}</p>{% endif %}
<p class="half">at {{ "%g"|format(100 * j.confidence) }} % confidence, the drive's torque scale included; \
repeatability, this drive: {{ inertia(j) }}</p>
{% if d.gear_ratio != 1.0 and d.inertia_main_shaft_kg_m2 %}{% set m = d.inertia_main_shaft_kg_m2 %}
<p class="half">at the main shaft {{ total(m) }}</p>{% endif %}
{% else %}<p class="big">No number</p>{% endif %}
<p class="verdict">{{ verdict }}</p>
<p>{{ d.reason[:1]|upper }}{{ d.reason[1:] }}.{% if d.advice %} <i>Advice: {{ d.advice }}.</i>{% endif %}</p>
</div>
{% for warning in d.warnings %}<p class="warn">{{ warning }}</p>{% endfor %}

{% if pictures.opinions %}<h2>All that this run says of the inertia</h2>
<figure>{{ pictures.opinions }}<figcaption>The result, and what other routes through the same data say. A second
opinion shares friction and torque scale with the result, and little else: where the two differ by more than their
intervals, one of the assumptions is wrong.</figcaption></figure>
{% for o in d.second_opinions %}
<p>{{ o.route }}: {{ interval(o.inertia_kg_m2, "kg·m²") }},
{% if o.agrees is none %}nothing to compare with{% elif o.agrees %}<b class="green">agrees</b>{% else %}\
<b class="red">does not agree</b>{% endif %}. {{ o.note[:1]|upper }}{{ o.note[1:] }}.</p>{% endfor %}{% endif %}

{% if pictures.lines %}<h2>Torque against acceleration, line by line</h2>
<figure>{{ pictures.lines }}<figcaption>At each excited frequency by itself the ratio of torque to acceleration looks
like another inertia, because the drive reports speed and torque late. The model explains all of them with one J, the
band. Below: what it leaves unexplained, in standard deviations; about 1 is chance.</figcaption></figure>{% endif %}

{% if pictures.budget %}<h2>What makes it unsure</h2>
<figure>{{ pictures.budget }}<figcaption>The half-width that each source alone would leave. They add up in squares,
about. The torque scale counts only in the wider interval.</figcaption></figure>
<table><tr><th class="text">source</th><th>± kg·m²</th><th class="text"></th></tr>
{% for line in d.budget %}<tr><td class="text">{{ line.source }}</td>
<td>{% if line.half_width_kg_m2 is none %}open{% else %}{{ "%.2g"|format(line.half_width_kg_m2) }}{% endif %}</td>
<td class="text">{{ line.note }}</td></tr>{% endfor %}</table>{% endif %}

{% if pictures.friction %}<h2>Friction over speed</h2>
<figure>{{ pictures.friction }}<figcaption>Torque at steady speed, load included; no lag touches
it.</figcaption></figure>
<table><tr><th>speed, rad/s</th><th>torque, N·m</th></tr>
{% for p in d.friction_curve %}<tr><td>{{ "%.3f"|format(p.speed_rad_s) }}</td>
<td>{{ plus_minus(p.torque_nm.value, 0.5 * (p.torque_nm.high - p.torque_nm.low)) }}</td></tr>
{% endfor %}</table>{% endif %}

{% if pictures.run %}<h2>The run</h2>
<figure>{{ pictures.run }}<figcaption>As reported, nothing smoothed. Green: steady levels. Blue: the excitation, its
settling lighter.</figcaption></figure>{% endif %}

<h2>Every number</h2>
{% if estimates %}<div class="wide"><table><tr><th class="text">quantity</th><th>value</th><th>low</th><th>high</th>
<th class="text">unit</th></tr>
{% for title, part, unit in estimates %}<tr><td class="text">{{ title }}</td>
{% for name in ("value", "low", "high") %}<td>{% if part[name] is none %}open{% else %}\
{{ "%.6g"|format(part[name]) }}{% endif %}</td>{% endfor %}<td class="text">{{ unit }}</td></tr>
{% endfor %}</table></div>{% endif %}
{% if d.lines %}<div class="wide"><table><caption>Lines</caption><tr><th>frequency, Hz</th>
<th>apparent inertia, kg·m²</th><th>model</th><th>damping Re(T/ω), N·m·s/rad</th><th>model</th>
<th>residual, sd</th></tr>
{% for p in d.lines %}{% set a = p.apparent_inertia_kg_m2 %}{% set b = p.apparent_damping_nm_s_rad %}
<tr><td>{{ "%.4g"|format(p.hertz) }}</td><td>{{ plus_minus(a.value, 0.5 * (a.high - a.low)) }}</td>
<td>{{ "%.5g"|format(p.fitted_inertia_kg_m2) }}</td><td>{{ plus_minus(b.value, 0.5 * (b.high - b.low)) }}</td>
<td>{{ "%.5g"|format(p.fitted_damping_nm_s_rad) }}</td><td>{{ "%.2f"|format(p.residual_sd) }}</td></tr>
{% endfor %}</table></div>{% endif %}
{% if d.stages %}<table><caption>Stages</caption><tr><th class="text">stage</th><th class="text">outcome</th>
<th>duration</th><th class="text"></th></tr>
{% for s in d.stages %}<tr><td class="text">{{ s.name }}</td><td class="text">{{ s.outcome }}</td>
<td>{{ s.duration_s|minutes }}</td><td class="text">{{ s.detail or "" }}</td></tr>{% endfor %}</table>{% endif %}
<table>{% for title, text in facts %}<tr><th class="text">{{ title }}</th><td class="text">{{ text }}</td></tr>
{% endfor %}</table>
</body></html>
"""
