//! The chart as a self-contained HTML page that shows values under the pointer.

use echotank_runtime::chart::Chart;

use super::table::{ChartContext, note, subtitle};
use echotank_drawing::escaped;

const STYLE: &str = "body{font:15px/1.45 system-ui,sans-serif;margin:1.5rem auto;max-width:1240px;color:#1b1f24;background:#fff}svg{max-width:100%;height:auto}table{border-collapse:collapse;font-size:13px}th,td{padding:3px 9px;text-align:right;border-bottom:1px solid #e4e7eb}th:last-child,td:last-child{text-align:left}tr.at{background:#fff3c4}tr.front td:last-child{font-weight:600}#tip{position:fixed;pointer-events:none;background:#1b1f24;color:#fff;padding:6px 9px;border-radius:5px;font-size:13px;white-space:pre;display:none;z-index:2}[data-row]{cursor:pointer}";

const SCRIPT: &str = "const tip=document.getElementById('tip');const rows=[...document.querySelectorAll('tr[data-row]')];function at(id){for(const r of rows)r.classList.toggle('at',r.dataset.row===id)}for(const p of document.querySelectorAll('svg [data-row]')){p.addEventListener('pointermove',e=>{tip.textContent=p.dataset.tip;tip.style.display='block';tip.style.left=Math.min(e.clientX+14,innerWidth-tip.offsetWidth-8)+'px';tip.style.top=(e.clientY+14)+'px';at(p.dataset.row)});p.addEventListener('pointerleave',()=>{tip.style.display='none'});p.addEventListener('click',()=>{const r=rows.find(r=>r.dataset.row===p.dataset.row);if(r)r.scrollIntoView({block:'center',behavior:'smooth'})})}";

pub(crate) fn html(chart: &Chart, svg: &str, work: Option<&str>, about: &ChartContext) -> String {
    let mut table = String::from(
        "<table><thead><tr><th>ms, median<th>min<th>max<th>element error<th>predicted<th>lines<th>image dB<th>level dB<th>method</tr></thead><tbody>",
    );
    for (k, row) in chart.rows.iter().enumerate() {
        let name = escaped(&row.method.to_string());
        let class = if row.pareto { " class=\"front\"" } else { "" };
        table += &match &row.outcome {
            Ok(m) => format!(
                "<tr data-row=\"{k}\"{class}><td>{:.2}<td>{:.2}<td>{:.2}<td>{:.1e}<td>{:.1e}<td>{}<td>{}<td>{:.3}<td>{name}{}</tr>\n",
                m.times.median_ms,
                m.times.min_ms,
                m.times.max_ms,
                m.errors.elements,
                row.predicted_error,
                m.errors.lines.map_or("-".into(), |e| format!("{e:.1e}")),
                m.errors.image_db.map_or("-".into(), |e| format!("{e:.3}")),
                m.errors.level_db,
                match note(row) {
                    note if note.is_empty() => note,
                    note => format!(" ({note})"),
                },
            ),
            Err(why) => format!(
                "<tr data-row=\"{k}\"><td colspan=\"4\">refused<td>{:.1e}<td><td><td><td>{name}: {}</tr>\n",
                row.predicted_error,
                escaped(why)
            ),
        };
    }
    table += "</tbody></table>";
    format!(
        "<!doctype html>\n<html lang=\"en\"><head><meta charset=\"utf-8\"><meta name=\"viewport\" content=\"width=device-width\"><meta http-equiv=\"Content-Security-Policy\" content=\"default-src 'none'; style-src 'unsafe-inline'; script-src 'unsafe-inline'\"><title>{0}: accuracy against speed</title><style>{STYLE}</style></head>\n<body><h1>{0}: accuracy against speed</h1><p>{1}. Methods on the Pareto front are bold in the table. Point at a mark for its values; click it for its row.</p>\n{svg}\n{table}\n{2}<div id=\"tip\"></div><script>{SCRIPT}</script></body></html>\n",
        escaped(&chart.sonar),
        escaped(&subtitle(chart, about)),
        work.map_or(String::new(), |svg| format!(
            "<h2>Cost against work</h2>\n{svg}\n"
        )),
    )
}
